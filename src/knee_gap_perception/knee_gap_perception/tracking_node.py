"""tracking_node: poses of the tracked scope in, from topics or Motive; scope_pose, with its error, out."""

import threading
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import message_class
from knee_gap_core.node.base_node import LATCHED_QOS, RESULT_QOS, TRACKER_QOS, BaseNode, run
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.seam import Fault
from knee_gap_core.values.poses import LensPose
from knee_gap_msgs.msg import ScopeCalibration, ScopeNotch, ScopeRotation
from knee_gap_perception.calibration.in_use import CalibrationParameters, hash_or_none
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages_tracking import (
    fill_lens_pose,
    fill_scope_calibration,
    fill_scope_rotation,
    notch_from_message,
)
from knee_gap_perception.scope_pose.pose_validity import Refusal, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker, TrackingParameters
from knee_gap_perception.trackers.body_source import Subscription
from knee_gap_perception.trackers.natnet.client import NatNetParameters
from knee_gap_perception.trackers.scope_feed import ScopeFeed, SourceParameters

# Number of diagnostics, one per second, after which a source without data is reported in the log as well.
DIAGNOSTICS_TO_LOG = 5
# How long one look at a source that waits may take [s]: as long as the node may take to end.
SOURCE_WAIT = 0.1


class TrackingNode(BaseNode):
    """Converts, calls the tracker, publishes. A rejected pose is not published."""

    def __init__(self) -> None:
        super().__init__("tracking_node", health=self.health)
        parameters = self.declare(TrackingParameters)
        validity, calibration = self.declare(ValidityParameters), self.declare(CalibrationParameters)
        source, natnet = self.declare(SourceParameters), self.declare(NatNetParameters)
        self.refuse_unknown_parameters()
        self._accepted_before = 0
        # Number of rejected poses since the last diagnostics, and the reason of the last one.
        self._refused, self._why_refused = 0, ""
        # Number of diagnostics in a row without a working source.
        self._silent = 0
        self._scope_pose = self.create_publisher(PoseWithCovarianceStamped, "scope_pose", RESULT_QOS)
        try:
            self._tracker = ScopeTracker(
                parameters, validity, calibration.load(), by_notch=calibration.scope_rotation_notch
            )
            self._feed = ScopeFeed(source, natnet, other_bodies=parameters.other_bodies, ros_now=self.now_ns)
        except PerceptionError as error:
            raise ConfigurationError(str(error)) from error
        if self._tracker.follows_rotation:
            self._scope_rotation = self.create_publisher(ScopeRotation, "scope_rotation", RESULT_QOS)
        self._calibration = self.create_publisher(ScopeCalibration, "scope_calibration", LATCHED_QOS)
        reported = fill_scope_calibration(
            ScopeCalibration(),
            "tracking_node",
            self._tracker.calibration,
            rotation_followed=self._tracker.follows_rotation,
            medium=calibration.used_in,
        )
        self._calibration.publish(reported)
        # Images and Motive's frames arrive in threads of their own.
        self._one_at_a_time = threading.Lock()
        if calibration.scope_rotation_notch:
            self.create_subscription(ScopeNotch, "scope_notch", self.on_notch, RESULT_QOS)
        self._ended = threading.Event()
        self._receiver: threading.Thread | None = None
        for subscription in self._feed.source.subscriptions:
            self.listen(subscription)
        if self._feed.source.waits:
            self._receiver = threading.Thread(target=self.receive, daemon=True)
            self._receiver.start()

    def now_ns(self) -> int:
        """ROS time, to which NatNet's exposure times are mapped."""
        return int(self.get_clock().now().nanoseconds)

    def listen(self, subscription: Subscription) -> None:
        """Subscribe to a topic of the source. Raises ConfigurationError if its messages are not installed."""
        try:
            kind = message_class(subscription.msgtype)
        except BagError as error:
            package = subscription.msgtype.partition("/")[0]
            raise ConfigurationError(
                f"source {self._feed.parameters.source} needs the package {package}, which is not installed"
            ) from error
        self.create_subscription(
            kind, subscription.topic, partial(self.on_message, subscription.put), TRACKER_QOS
        )
        self.watch_input(subscription.topic)

    def on_message(self, put: Any, message: Any) -> None:
        """Pass a message to the source, and publish the poses of the frames that it completes."""
        put(message)
        self.publish_polled(0.0)

    def receive(self) -> None:
        """Publish what the source receives, until the node ends; in a thread of its own, because it waits."""
        poll = self.guarded("frame of the tracker", partial(self.publish_polled, SOURCE_WAIT))
        while not self._ended.is_set():
            faults = self.seam.counts.total()
            poll()
            if self.seam.counts.total() > faults:
                # What raises at once whenever it is looked at must not take the whole processor.
                self._ended.wait(SOURCE_WAIT)

    def publish_polled(self, timeout: float) -> None:
        """Publish the lens pose of each new frame, or log why there is none."""
        for body, others in self._feed.poll(timeout):
            with self._one_at_a_time:
                self.publish_lenses(self._tracker.take(body, others))

    def on_notch(self, message: ScopeNotch) -> None:
        """Receive the notch in an image, and publish the lens pose at its stamp."""
        with self._one_at_a_time:
            self.publish_lenses(self._tracker.take_notch(notch_from_message(message)))

    def recover(self, fault: Fault) -> None:
        """Reset the tracker; the pose that raised is not published."""
        with self._one_at_a_time:
            self._tracker.reset()
        self._refused, self._why_refused = self._refused + 1, fault.reason

    def publish_lenses(self, lenses: Iterable[LensPose | Refusal]) -> None:
        """Publish poses of the lens, and log why there are none."""
        for lens in lenses:
            if isinstance(lens, LensPose):
                if self._tracker.follows_rotation:
                    self._scope_rotation.publish(fill_scope_rotation(ScopeRotation(), lens))
                self._scope_pose.publish(fill_lens_pose(PoseWithCovarianceStamped(), lens))
            else:
                self._refused, self._why_refused = self._refused + 1, lens.detail
                self.log_once(lens.reason, f"pose rejected: {lens.detail}")

    def destroy_node(self) -> None:
        """End the receiver before the publishers that it uses."""
        self._ended.set()
        if self._receiver is not None:
            self._receiver.join()
        self._feed.close()
        super().destroy_node()

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """Status of the source, and poses accepted and rejected since the last diagnostics."""
        accepted = self._tracker.accepted_count - self._accepted_before
        self._accepted_before = self._tracker.accepted_count
        source = self._feed.status()
        self._silent = 0 if source.ok else self._silent + 1
        if self._silent == DIAGNOSTICS_TO_LOG:
            self.get_logger().warning(source.words)
        refused: dict[str, object] = {
            f"refused: {reason}": count for reason, count in dict(self._tracker.validity.counts).items()
        }
        words = f"{accepted} poses in the last second" if source.ok else source.words
        if source.ok and not accepted and self._tracker.notch_flaw:
            words = self._tracker.notch_flaw
        elif source.ok and self._refused:
            words += f", {self._refused} rejected: {self._why_refused}"
        self._refused = 0
        counts: dict[str, object] = {
            "calibration": hash_or_none(self._tracker.calibration),
            "accepted": self._tracker.accepted_count,
            **source.values,
            **refused,
        }
        if self._tracker.follows_rotation:
            counts["turn of the scope [rad]"] = self._tracker.turn
        return source.ok and accepted > 0, words, counts


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TrackingNode, argv)
