"""The images of one scope, as messages, to the edges in each: all of segmentation_node but ROS."""

from collections import Counter
from typing import Any

from knee_gap_perception.camera import Camera, camera_from_info
from knee_gap_perception.edge_detector import GapEdgeDetector
from knee_gap_perception.edge_parameters import EdgeParameters
from knee_gap_perception.edges import EdgeStatus, GapEdges
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.lens_pose_prediction import LensPosePredictor
from knee_gap_perception.messages import (
    Image,
    image_from_compressed,
    image_from_message,
    lens_pose_from_message,
    stamp_ns,
)
from knee_gap_perception.overlay import draw_overlay

NO_CAMERA = "no camera_info received yet"


class EdgeStream:
    """Takes sensor_msgs by field name; whatever is wrong with one is a status, a reason and a count."""

    def __init__(self, parameters: EdgeParameters | None = None) -> None:
        self.detector = GapEdgeDetector(parameters)
        self.counts: Counter[str] = Counter()
        self.latest: GapEdges | None = None
        self.reason = "no image received yet"
        self._image: Image | None = None
        self._camera: Camera | None = None
        self._camera_flaw = NO_CAMERA
        self._poses = LensPosePredictor()
        self._camera_key: tuple[object, ...] = ()

    def on_camera_info(self, message: Any) -> None:
        """Take the camera model of a sensor_msgs/CameraInfo; one that differs ends the track."""
        key = (message.width, message.height, message.distortion_model, tuple(message.k), tuple(message.d))
        if key == self._camera_key:
            return
        self._camera_key = key
        # Bearings by another model are not comparable with those before.
        self.detector.end_track()
        try:
            self._camera, self._camera_flaw = camera_from_info(message), ""
        except PerceptionError as error:
            self._camera, self._camera_flaw = None, str(error)

    def on_lens_pose(self, message: Any) -> None:
        """Take a pose of the lens, a geometry_msgs/PoseWithCovarianceStamped; a bad one is left out."""
        try:
            self._poses.add(lens_pose_from_message(message))
        except PerceptionError as error:
            self.counts[f"lens pose refused: {error}"] += 1

    def on_image(self, message: Any) -> GapEdges:
        """Edges in a sensor_msgs/Image or sensor_msgs/CompressedImage."""
        stamp, frame_id = stamp_ns(message.header), str(message.header.frame_id)
        try:
            is_compressed = hasattr(message, "format")
            image = image_from_compressed(message) if is_compressed else image_from_message(message)
            self._image = image
            if self._camera is None:
                raise PerceptionError(self._camera_flaw)
            lens_pose = self._poses.at(stamp)
            edges = self.detector.process(stamp, image, self._camera, lens_pose, frame_id=frame_id)
            self.reason = self.detector.reason
        except PerceptionError as error:
            self.detector.end_track()
            edges = GapEdges.without_points(stamp, frame_id, EdgeStatus.UNKNOWN)
            self.reason = str(error)
        self.latest = edges
        self.counts[edges.status.name] += 1
        return edges

    def overlay(self) -> Image | None:
        """The last image with all that was found drawn on it; None before the first."""
        if self._image is None or self.latest is None:
            return None
        mask = self.detector.gap_mask()
        return draw_overlay(self._image, self.latest, mask, self.reason, self._camera)
