"""segmentation_node: images of the scope in; gap_edges (edges of the gap and two points beside them) out."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf
from time import monotonic, time
from typing import Any

from geometry_msgs.msg import PointStamped
from rclpy.clock import Clock, ClockType
from std_srvs.srv import Trigger

from knee_gap_core.live.base_node import RESULT_QOS, run
from knee_gap_core.live.local_topics import LocalSubscription
from knee_gap_core.live.wired_node import WiredNode, blank
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Health, Output
from knee_gap_msgs.srv import ChoosePoint
from knee_gap_perception.edge_tracking.parameters import TransportParameters
from knee_gap_perception.edge_tracking.segmentation_core import (
    IMAGES,
    NODE,
    PICTURES,
    SCOPE_POSE,
    SegmentationCore,
)
from knee_gap_perception.edge_tracking.warm_up import warm_up
from knee_gap_perception.errors import PerceptionError

# How often it is looked which of the image topics is published, until one is [s].
TRANSPORT_LOOK = 0.1


class SegmentationNode(WiredNode):
    """Hands messages to its core, and drops images that are late. Pictures are made only for subscribers."""

    core: SegmentationCore

    def __init__(self) -> None:
        super().__init__(NODE)
        transport = self.declare(TransportParameters)
        parameters = self.declare_all(SegmentationCore.parameters)
        self.refuse_unknown_parameters()
        try:
            self.core = SegmentationCore.from_parameters(parameters, blank, first_track_id=unused_track_id())
        except PerceptionError as error:
            raise ConfigurationError(str(error)) from error
        # Compiled before the first image, so that its result is not late.
        warm_up()
        self._longest_lag_ns = round(1e9 * transport.max_image_lag)
        self._picture_period = 1.0 / transport.picture_rate
        self._last_picture = -inf
        self._dropped = 0
        self._sequence: int | None = None
        self.open_outputs([*self.core.outputs, *PICTURES])
        for given in self.core.inputs:
            if given == SCOPE_POSE:
                self._poses = self.listen(given, partial(self.on_message, given.topic))
            elif given not in IMAGES.values():
                self.listen(given, partial(self.on_message, given.topic))
        self.create_subscription(PointStamped, "clicked_point", self.on_click, RESULT_QOS)
        self.create_service(ChoosePoint, "choose_point", self.on_choose)
        self.create_service(Trigger, "restart", self.on_restart)
        self._is_auto = transport.image_transport == "auto"
        self.subscribe_to_images("raw" if self._is_auto else transport.image_transport)
        self.publish(self.core.begin(self.now_ns()))
        self._publish_more = self.one_at_a_time(self.guarded("image", self.publish_ready))
        # Runs while an image waits for its pose, so that it does not wait too long.
        self._patience = self.create_timer(max(self.core.longest_wait, 0.001), self.publish_ready)
        self._patience.cancel()

    def subscribe_to_images(self, transport: str) -> None:
        """Subscribe to the images of a transport, raw or compressed."""
        self._transport = transport
        self._images = self.listen(IMAGES[transport], self.on_image)
        if self._is_auto:
            # By the steady clock: a bag's may stand still before the first image.
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._transport_timer = self.create_timer(TRANSPORT_LOOK, self.choose_transport, clock=clock)

    def choose_transport(self) -> None:
        """Change to the other transport if only that one is published, until the first image comes."""
        other = next(name for name in IMAGES if name != self._transport)
        published = {
            name: self.count_publishers(self.resolve_topic_name(given.topic)) > 0
            for name, given in IMAGES.items()
        }
        if self.core.stream.latest is None and not published[self._transport]:
            if not published[other]:
                return
            self.forget_input(IMAGES[self._transport].topic)
            self.destroy_subscription(self._images)
            self.get_logger().info(f"{IMAGES[other].topic} is published: image_transport is {other}")
            self._is_auto = False
            self.subscribe_to_images(other)
        self._transport_timer.cancel()

    def on_message(self, topic: str, message: Any) -> None:
        """Receive a camera model, or a lens pose, which an image may be waiting for."""
        self.publish(self.core.take(topic, message, self.now_ns()))
        self.publish_ready()

    def on_image(self, message: Any, info: Mapping[str, int | None]) -> None:
        """Receive an image; it is processed now, or once the pose after it has arrived."""
        self.take_image(message, info)
        self.publish_ready()

    def take_image(self, message: Any, info: Mapping[str, int | None]) -> None:
        """Hand an image to the core, of which only its notch is published yet."""
        self.count_dropped(info.get("publication_sequence_number"))
        self.publish(self.core.take(IMAGES[self._transport].topic, message, self.now_ns()))

    def publish_ready(self) -> None:
        """Publish the edges of the next image that is ready, and the pictures that have subscribers.

        More images have their turn after whatever else has arrived: a busy machine must not starve the poses.
        """
        self.take_waiting()
        for one in self.core.ready(self.now_ns()):
            self.publish([one])
            if isinstance(one, Output):
                self.take_waiting()
                self.publish_pictures()
                if self.core.stream.waiting:
                    self.executor.create_task(self._publish_more)
                break
        self.set_patience()

    def publish_pictures(self) -> None:
        """Publish mask and overlay of the latest image, unless the last ones are recent or an image waits."""
        watched = [one for one in PICTURES if self._outlets[one.topic].get_subscription_count()]
        if not watched or self.core.stream.waiting or monotonic() - self._last_picture < self._picture_period:
            return
        self._last_picture = monotonic()
        self.publish(picture for one in watched if (picture := self.core.picture(one)) is not None)

    def set_patience(self) -> None:
        """Let the timer run while an image waits."""
        if not self.core.stream.waiting:
            self._patience.cancel()
        elif self._patience.is_canceled():
            self._patience.reset()

    def recover(self, fault: Fault) -> None:
        """Reset the core, and publish unknown edges for the image that raised."""
        super().recover(fault)
        self.set_patience()

    def take_waiting(self) -> None:
        """Receive all poses and images that have arrived; drop images that are too old by then.

        The executor takes one message of each topic per cycle. Poses arrive twice as often as images, so on a
        busy machine they would fall behind and be too old for every image; and the newest image would wait
        behind all the others.
        """
        self.take_all(
            self._poses,
            lambda taken: self.publish(self.core.take(SCOPE_POSE.topic, taken[0], self.now_ns())),
        )
        if not self._longest_lag_ns:
            return  # the middleware's queue bounds how many images wait
        self.take_all(self._images, lambda taken: self.take_image(*taken))
        self._dropped += self.core.stream.drop_old(self._longest_lag_ns, self.now_ns())

    def take_all(self, subscription: Any, handle: Callable[[Any], None]) -> None:
        """Handle the messages that wait in a subscription, each with its info."""
        if isinstance(subscription, LocalSubscription):
            return  # nothing waits in it
        with subscription.handle:
            while (taken := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                handle(taken)

    def on_click(self, message: PointStamped) -> None:
        """As `choose_point`, for a pixel with x as column and y as row; a refusal is logged."""
        if reason := self.core.stream.choose(message.point.x, message.point.y):
            self.get_logger().warning(f"clicked_point refused: {reason}")

    def on_choose(self, request: ChoosePoint.Request, answer: ChoosePoint.Response) -> ChoosePoint.Response:
        """Choose the section nearest to a pixel, if there is a gap in the latest image."""
        answer.reason = self.core.stream.choose(request.column, request.row)
        answer.accepted = not answer.reason
        return answer

    def on_restart(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """End the track; the next image with a gap starts a new one."""
        self.core.stream.detector.restart()
        answer.success, answer.message = True, "the next image with a gap starts a new track"
        return answer

    def count_dropped(self, number: int | None) -> None:
        """Count the images that the middleware dropped because newer ones were waiting."""
        if number is not None and self._sequence is not None and number > self._sequence + 1:
            self._dropped += number - self._sequence - 1
        self._sequence = number

    def health(self) -> Health:
        """Health of the core, and the number of images dropped."""
        well, words, rows = self.core.health()
        return well, words, {**rows, "images dropped": self._dropped}


def unused_track_id() -> int:
    """First track number of this process, so that its tracks differ from those of an earlier process.

    A thousand for each second, from 1 to 4e9.
    """
    return 1 + 1000 * (int(time()) % 4_000_000)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(SegmentationNode, argv)
