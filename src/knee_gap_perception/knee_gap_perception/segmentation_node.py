"""segmentation_node: images of the scope in; gap_edges (edges of the gap and two points beside them) out."""

from collections.abc import Mapping, Sequence
from math import inf
from time import monotonic, time

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

from knee_gap_core.node.base_node import IMAGE_QOS, LATCHED_QOS, RESULT_QOS, BaseNode, run
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.seam import Fault
from knee_gap_core.values.edge_messages import fill_gap_edges
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.edges import GapEdges as Edges
from knee_gap_msgs.msg import GapEdges, GapSection, ScopeCalibration, ScopeNotch
from knee_gap_msgs.srv import ChoosePoint
from knee_gap_perception.calibration.in_use import CalibrationParameters, hash_or_none
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import (
    CameraInfoParameters,
    PoseParameters,
    TransportParameters,
)
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.messages_tracking import fill_scope_calibration, fill_scope_notch
from knee_gap_perception.warm_up import warm_up

TRANSPORTS = {"raw": (Image, "image_raw"), "compressed": (CompressedImage, "image_raw/compressed")}
# How often it is looked which of them is published, until one is [s].
TRANSPORT_LOOK = 0.1


class SegmentationNode(BaseNode):
    """Converts, calls the core, publishes. Mask and overlay are made only if they have subscribers."""

    def __init__(self) -> None:
        super().__init__("segmentation_node", health=self.health)
        transport = self.declare(TransportParameters)
        poses = self.declare(PoseParameters)
        edges, calibration = self.declare(EdgeParameters), self.declare(CalibrationParameters)
        camera_info = self.declare(CameraInfoParameters)
        self.refuse_unknown_parameters()
        try:
            self._stream = EdgeStream(
                edges,
                poses,
                calibration.load(),
                by_notch=calibration.scope_rotation_notch,
                first_track_id=unused_track_id(),
                medium=calibration.used_in,
                camera_info_medium=camera_info.calibrated_in,
            )
        except PerceptionError as error:
            raise ConfigurationError(str(error)) from error
        # Compiled before the first image, so that its result is not late.
        warm_up()
        self._longest_lag_ns = round(1e9 * transport.max_image_lag)
        self._picture_period = 1.0 / transport.picture_rate
        self._last_picture = -inf
        self._dropped = 0
        self._sequence: int | None = None
        self._edges = self.create_publisher(GapEdges, "gap_edges", RESULT_QOS)
        if calibration.scope_rotation_notch:
            self._notch = self.create_publisher(ScopeNotch, "scope_notch", RESULT_QOS)
        self._mask = self.create_publisher(Image, "gap_mask", IMAGE_QOS)
        self._overlay = self.create_publisher(Image, "~/overlay", IMAGE_QOS)
        self.create_subscription(CameraInfo, "camera_info", self._stream.on_camera_info, IMAGE_QOS)
        if self._stream.calibration is None:
            self.watch_input("camera_info")
        self.create_subscription(PointStamped, "clicked_point", self.on_click, RESULT_QOS)
        self.create_service(ChoosePoint, "choose_point", self.on_choose)
        self.create_service(Trigger, "restart", self.on_restart)
        self._poses = self.create_subscription(
            # Reliable, since lost poses would leave a gap that ends the track.
            PoseWithCovarianceStamped,
            "scope_pose",
            self.on_pose,
            RESULT_QOS,
        )
        self._is_auto = transport.image_transport == "auto"
        self.subscribe_to_images("raw" if self._is_auto else transport.image_transport)
        self._calibration = self.create_publisher(ScopeCalibration, "scope_calibration", LATCHED_QOS)
        reported = fill_scope_calibration(ScopeCalibration(), "segmentation_node", self._stream.calibration)
        self._calibration.publish(reported)
        # Runs while an image waits for its pose, so that it does not wait too long.
        self._patience = self.create_timer(max(poses.max_pose_wait, 0.001), self.publish_ready)
        self._patience.cancel()

    def subscribe_to_images(self, transport: str) -> None:
        """Subscribe to the images of a transport, raw or compressed."""
        self._transport = transport
        self._kind, topic = TRANSPORTS[transport]
        self._images = self.create_subscription(self._kind, topic, self.on_image, IMAGE_QOS)
        self.watch_input(topic)
        if self._is_auto:
            # By the steady clock: a bag's may stand still before the first image.
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._transport_timer = self.create_timer(TRANSPORT_LOOK, self.choose_transport, clock=clock)

    def choose_transport(self) -> None:
        """Change to the other transport where only that one is published, until the first image comes."""
        other = next(name for name in TRANSPORTS if name != self._transport)
        published = {
            name: self.count_publishers(self.resolve_topic_name(topic)) > 0
            for name, (_, topic) in TRANSPORTS.items()
        }
        if self._stream.latest is None and not published[self._transport]:
            if not published[other]:
                return
            self.forget_input(TRANSPORTS[self._transport][1])
            self.destroy_subscription(self._images)
            self.get_logger().info(f"{TRANSPORTS[other][1]} is published: image_transport is {other}")
            self._is_auto = False
            self.subscribe_to_images(other)
        self._transport_timer.cancel()

    def on_image(self, message: Image | CompressedImage, info: Mapping[str, int | None]) -> None:
        """Receive an image; it is processed now, or once the pose after it has arrived."""
        self.take_image(message, info)
        self.publish_ready()

    def take_image(self, message: Image | CompressedImage, info: Mapping[str, int | None]) -> None:
        """Hand an image to the core, which publishes nothing of it yet but its notch."""
        self.count_dropped(info.get("publication_sequence_number"))
        if (observation := self._stream.on_image(message, self.now_ns())) is not None:
            # At once, because the pose that the image waits for depends on it.
            self._notch.publish(fill_scope_notch(ScopeNotch(), observation, message.header.frame_id))

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Receive a lens pose, which an image may be waiting for."""
        self._stream.on_lens_pose(message)
        self.publish_ready()

    def publish_ready(self) -> None:
        """Publish the edges of the images that are ready, and the pictures that have subscribers."""
        self.take_waiting()
        for edges in self._stream.ready(self.now_ns()):
            message = self.publish_edges(edges)
            self.take_waiting()
            self.publish_pictures(message)
        self.set_patience()

    def publish_pictures(self, edges: GapEdges) -> None:
        """Publish mask and overlay of the latest image, unless the last ones are recent or an image waits."""
        watched = [one for one in (self._mask, self._overlay) if one.get_subscription_count()]
        if not watched or self._stream.waiting or monotonic() - self._last_picture < self._picture_period:
            return
        self._last_picture = monotonic()
        if self._mask in watched and (mask := self._stream.mask()) is not None:
            self.publish_picture(self._mask, mask, "mono8", edges)
        if self._overlay in watched and (drawn := self._stream.overlay()) is not None:
            self.publish_picture(self._overlay, drawn, "bgr8", edges)

    def publish_edges(self, edges: Edges) -> GapEdges:
        """Publish the edges found in one image; return the message."""
        message = fill_gap_edges(GapEdges(), edges, GapSection)
        self._edges.publish(message)
        if self._stream.reason:
            self.log_once(edges.status.name, f"{edges.status.name}: {self._stream.reason}")
        return message

    def set_patience(self) -> None:
        """Let the timer run while an image waits."""
        if not self._stream.waiting:
            self._patience.cancel()
        elif self._patience.is_canceled():
            self._patience.reset()

    def recover(self, fault: Fault) -> None:
        """Reset the stream, and publish unknown edges for the image that raised."""
        for edges in self._stream.recover(fault.reason):
            self.publish_edges(edges)
        self.set_patience()

    def take_waiting(self) -> None:
        """Receive all poses and images that have arrived; drop images that are too old by then.

        The executor takes one message of each topic per cycle. Poses arrive twice as often as images, so on a
        busy machine they would fall behind and be too old for every image; and the newest image would wait
        behind all the others.
        """
        with self._poses.handle:
            while (taken := self._poses.handle.take_message(PoseWithCovarianceStamped, False)) is not None:
                self._stream.on_lens_pose(taken[0])
        if not self._longest_lag_ns:
            return  # the middleware's queue bounds how many images wait
        with self._images.handle:
            while (taken := self._images.handle.take_message(self._kind, False)) is not None:
                self.take_image(*taken)
        self._dropped += self._stream.drop_old(self._longest_lag_ns, self.now_ns())

    def now_ns(self) -> int:
        """Clock for waiting times; with use_sim_time the bag's, so that a slow replay waits longer."""
        return int(self.get_clock().now().nanoseconds)

    def on_click(self, message: PointStamped) -> None:
        """As `choose_point`, for a pixel with x as column and y as row; a refusal is logged."""
        if reason := self._stream.choose(message.point.x, message.point.y):
            self.get_logger().warning(f"clicked_point refused: {reason}")

    def on_choose(self, request: ChoosePoint.Request, answer: ChoosePoint.Response) -> ChoosePoint.Response:
        """Choose the section nearest to a pixel, if there is a gap in the latest image."""
        answer.reason = self._stream.choose(request.column, request.row)
        answer.accepted = not answer.reason
        return answer

    def on_restart(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """End the track; the next image with a gap starts a new one."""
        self._stream.detector.restart()
        answer.success, answer.message = True, "the next image with a gap starts a new track"
        return answer

    def publish_picture(
        self,
        publisher: Publisher,
        picture: npt.NDArray[np.uint8],
        encoding: str,
        edges: GapEdges,
    ) -> None:
        """Publish a picture made from an image, with the header of its edges, which is the image's."""
        message = Image(
            header=edges.header, height=picture.shape[0], width=picture.shape[1], encoding=encoding
        )
        message.step = picture.strides[0]
        message.data = picture.tobytes()
        publisher.publish(message)

    def count_dropped(self, number: int | None) -> None:
        """Count the images that the middleware dropped because newer ones were waiting."""
        if number is not None and self._sequence is not None and number > self._sequence + 1:
            self._dropped += number - self._sequence - 1
        self._sequence = number

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """Status of the latest image, count of each status, and the reason of the last refusal."""
        latest = self._stream.latest
        well = latest is not None and latest.status is EdgeStatus.VALID
        counts: dict[str, object] = {**self._stream.counts, "images dropped": self._dropped}
        counts["last refusal"] = self._stream.last_refusal
        counts["confidence of the last search"] = self._stream.detector.confidence
        return well, self._stream.reason, {"calibration": hash_or_none(self._stream.calibration), **counts}


def unused_track_id() -> int:
    """First track number of this process, so that its tracks differ from those of an earlier process.

    A thousand for each second, from 1 to 4e9.
    """
    return 1 + 1000 * (int(time()) % 4_000_000)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(SegmentationNode, argv)
