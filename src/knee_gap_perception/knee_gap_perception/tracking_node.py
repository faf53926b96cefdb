"""tracking_node: poses of the tracked scope in, from topics or Motive; scope_pose, with its error, out."""

import threading
from collections.abc import Sequence
from functools import partial
from typing import Any

from knee_gap_core.bag.errors import BagError
from knee_gap_core.live.base_node import run
from knee_gap_core.live.wired_node import WiredNode, blank
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Health
from knee_gap_core.values import quaternions
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.frame_tree import FrameParameters
from knee_gap_perception.scope_pose.tracking_core import NODE, TRANSFORMS, TrackingCore

# Number of diagnostics, one per second, after which a source without data is reported in the log as well.
DIAGNOSTICS_TO_LOG = 5
# How long one look at a source that waits may take [s]: as long as the node may take to end.
SOURCE_WAIT = 0.1


class TrackingNode(WiredNode):
    """Hands messages and frames of the tracker to its core. A rejected pose is not published."""

    core: TrackingCore

    def __init__(self) -> None:
        super().__init__(NODE)
        parameters = self.declare_all(TrackingCore.parameters)
        frames = self.declare(FrameParameters)
        self.refuse_unknown_parameters()
        # Number of diagnostics in a row without a working source.
        self._silent = 0
        try:
            self.core = TrackingCore.from_parameters(parameters, blank, ros_now=self.now_ns)
            if frames.publish_tf:
                self.core.broadcast_frames(frames, lambda: self.has_subscribers(TRANSFORMS))
        except PerceptionError as error:
            raise ConfigurationError(str(error)) from error
        self.open_outputs(self.core.outputs)
        self.publish(self.core.begin(self.now_ns()))
        quaternions.warm_up()
        # Images and Motive's frames arrive in threads of their own.
        self._one_at_a_time = threading.Lock()
        for given in self.core.inputs:
            try:
                self.listen(given, partial(self.on_message, given.topic))
            except BagError as error:
                package = given.msgtype.partition("/")[0]
                source = self.core.feed.parameters.source
                raise ConfigurationError(
                    f"source {source} needs the package {package}, which is not installed"
                ) from error
        self._ended = threading.Event()
        self._receiver: threading.Thread | None = None
        if self.core.feed.source.waits:
            self._receiver = threading.Thread(target=self.receive, daemon=True)
            self._receiver.start()

    def on_message(self, topic: str, message: Any) -> None:
        """Receive a notch or a message of the source, and publish the lens poses that follow from it."""
        with self._one_at_a_time:
            self.publish(self.core.take(topic, message, self.now_ns()))

    def receive(self) -> None:
        """Publish what the source receives, until the node ends; in a thread of its own, because it waits."""
        poll = self.guarded("frame of the tracker", self.publish_polled)
        while not self._ended.is_set():
            faults = self.seam.counts.total()
            poll()
            if self.seam.counts.total() > faults:
                # What raises at once whenever it is looked at must not take the whole processor.
                self._ended.wait(SOURCE_WAIT)

    def publish_polled(self) -> None:
        """Publish the lens pose of each new frame, or log why there is none."""
        for frame in self.core.poll(SOURCE_WAIT):
            if not self.is_active:
                continue  # the source is kept alive, and what it received is not used
            with self._one_at_a_time:
                self.publish(self.core.take_frame(frame))

    def recover(self, fault: Fault) -> None:
        """Reset the tracker; the pose that raised is not published."""
        with self._one_at_a_time:
            super().recover(fault)

    def destroy_node(self) -> None:
        """End the receiver before the publishers that it uses."""
        self._ended.set()
        if self._receiver is not None:
            self._receiver.join()
        self.core.feed.close()
        super().destroy_node()

    def health(self) -> Health:
        """Health of the core; a source that stays silent is reported in the log as well."""
        well, words, rows = self.core.health()
        self._silent = 0 if self.core.source_works else self._silent + 1
        if self._silent == DIAGNOSTICS_TO_LOG:
            self.get_logger().warning(words)
        return well, words, rows


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TrackingNode, argv)
