"""The core of segmentation_node: images, camera model and lens poses in; gap edges and the notch out."""

from collections.abc import Iterator, Sequence
from typing import Any, Self

import numpy as np

from knee_gap_core.conversions.edge_messages import fill_gap_edges
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Blank, Health, InputTopic, Notice, Outcome, Output, OutputTopic, Qos
from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.stamps import set_stamp
from knee_gap_perception.calibration.in_use import CalibrationParameters, hash_or_none
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import CameraInfoParameters, PoseParameters
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.messages_tracking import fill_scope_calibration, fill_scope_notch

NODE = "segmentation_node"
CAMERA_INFO = InputTopic("camera_info", "sensor_msgs/msg/CameraInfo", Qos.IMAGE, from_driver=True)
# Reliable, since lost poses would leave a gap that ends the track.
SCOPE_POSE = InputTopic("scope_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", Qos.RESULT)
# By the parameter image_transport; a shell subscribes to one of them.
IMAGES = {
    "raw": InputTopic("image_raw", "sensor_msgs/msg/Image", Qos.IMAGE, from_driver=True, needed=True),
    "compressed": InputTopic(
        "image_raw/compressed",
        "sensor_msgs/msg/CompressedImage",
        Qos.COMPRESSED_IMAGE,
        from_driver=True,
        needed=True,
    ),
}
GAP_EDGES = OutputTopic("gap_edges", "knee_gap_msgs/msg/GapEdges", Qos.RESULT)
CALIBRATION = OutputTopic(
    "scope_calibration", "knee_gap_msgs/msg/ScopeCalibration", Qos.LATCHED, optional=True
)
SCOPE_NOTCH = OutputTopic("scope_notch", "knee_gap_msgs/msg/ScopeNotch", Qos.RESULT, optional=True)
# Pictures of the latest image, which are made only if somebody wants them.
GAP_MASK = OutputTopic("gap_mask", "sensor_msgs/msg/Image", Qos.IMAGE, optional=True)
OVERLAY = OutputTopic("~/overlay", "sensor_msgs/msg/Image", Qos.IMAGE, optional=True)
PICTURES = (GAP_MASK, OVERLAY)


class SegmentationCore:
    """Turns messages into those that segmentation_node publishes, by an `EdgeStream`."""

    parameters: tuple[type, ...] = (
        EdgeParameters,
        PoseParameters,
        CalibrationParameters,
        CameraInfoParameters,
    )

    @classmethod
    def from_parameters(cls, given: Sequence[Any], blank: Blank, *, first_track_id: int = 1) -> Self:
        """A core with one instance of each of `parameters`. Raises PerceptionError for unusable ones."""
        edges, poses, calibration, camera_info = given
        stream = EdgeStream(
            edges,
            poses,
            calibration.load(),
            by_notch=calibration.scope_rotation_notch,
            first_track_id=first_track_id,
            medium=calibration.used_in,
            camera_info_medium=camera_info.calibrated_in,
        )
        return cls(stream, blank)

    def __init__(self, stream: EdgeStream, blank: Blank) -> None:
        self.stream = stream
        self._blank = blank

    @property
    def longest_wait(self) -> float:
        """How long an image waits for the lens pose after it [s]."""
        return self.stream.longest_wait

    @property
    def inputs(self) -> tuple[InputTopic, ...]:
        """The camera model and the pose before the image."""
        camera_info = CAMERA_INFO._replace(needed=self.stream.calibration is None)
        return (camera_info, SCOPE_POSE, *IMAGES.values())

    @property
    def outputs(self) -> tuple[OutputTopic, ...]:
        """Topics beside the `PICTURES`."""
        return (GAP_EDGES, CALIBRATION, *([SCOPE_NOTCH] if self.stream.by_notch else []))

    def begin(self, now_ns: int) -> list[Outcome]:
        """The calibration in use."""
        message = fill_scope_calibration(self._blank(CALIBRATION.msgtype), NODE, self.stream.calibration)
        return [Output(CALIBRATION.topic, message, now_ns)]

    def take(self, topic: str, message: Any, now_ns: int, queued_ns: int = 0) -> list[Outcome]:
        """Receive a message. The notch of an image is published at once, because its pose depends on it."""
        if topic == CAMERA_INFO.topic:
            self.stream.on_camera_info(message)
        elif topic == SCOPE_POSE.topic:
            self.stream.on_lens_pose(message)
        elif (observation := self.stream.on_image(message, now_ns)) is not None:
            frame_id = str(message.header.frame_id)
            notch = fill_scope_notch(self._blank(SCOPE_NOTCH.msgtype), observation, frame_id)
            return [Output(SCOPE_NOTCH.topic, notch, observation.stamp_ns)]
        return []

    def ready(self, now_ns: int) -> Iterator[Outcome]:
        """Edges of the images that need not wait for a pose any longer, each found when it is asked for."""
        for edges in self.stream.ready(now_ns):
            yield from self._reported(edges)

    def finish(self, now_ns: int) -> Iterator[Outcome]:
        """Edges of the images for which no pose will come any more."""
        for edges in self.stream.finish():
            yield from self._reported(edges)

    def recover(self, fault: Fault) -> list[Outcome]:
        """Reset the stream; unknown edges for the image that raised."""
        return [one for edges in self.stream.recover(fault.reason) for one in self._reported(edges)]

    def picture(self, topic: OutputTopic) -> Output | None:
        """Mask or overlay of the latest image; None if that could not be read."""
        edges = self.stream.latest
        drawn, encoding = (
            (self.stream.mask(), "mono8") if topic is GAP_MASK else (self.stream.overlay(), "bgr8")
        )
        if edges is None or drawn is None:
            return None
        message = self._blank(topic.msgtype)
        set_stamp(message.header, edges.stamp_ns)
        message.header.frame_id = edges.frame_id
        return Output(topic.topic, _filled(message, drawn, encoding), edges.stamp_ns)

    def health(self) -> Health:
        """Status of the latest image, count of each status, and the reason of the last refusal."""
        latest = self.stream.latest
        well = latest is not None and latest.status is EdgeStatus.VALID
        rows: dict[str, object] = {
            "calibration": hash_or_none(self.stream.calibration),
            **self.stream.counts,
            "last refusal": self.stream.last_refusal,
            "confidence of the last search": self.stream.detector.confidence,
        }
        return well, self.stream.reason, rows

    def _reported(self, edges: GapEdges) -> list[Outcome]:
        message = fill_gap_edges(
            self._blank(GAP_EDGES.msgtype), edges, lambda: self._blank("knee_gap_msgs/msg/GapSection")
        )
        edges_output = Output(GAP_EDGES.topic, message, edges.stamp_ns)
        if reason := self.stream.reason:
            return [Notice(edges.status.name, f"{edges.status.name}: {reason}"), edges_output]
        return [edges_output]


def _filled(message: Any, picture: Image, encoding: str) -> Any:
    """A sensor_msgs/Image with a picture (height, width) or (height, width, 3)."""
    message.height, message.width = picture.shape[:2]
    message.encoding, message.step = encoding, picture.strides[0]
    flat = picture.ravel()
    # Messages for bags hold arrays of NumPy, those of ROS take bytes.
    message.data = flat if isinstance(message.data, np.ndarray) else flat.tobytes()
    return message
