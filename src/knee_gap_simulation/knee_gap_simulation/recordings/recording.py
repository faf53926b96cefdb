"""A simulated recording as a bag: images, camera, tracked and true poses, with the scene in the metadata."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from knee_gap_core.bag.bag import BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import inverse, quaternion_xyzw
from knee_gap_core.values.stamps import set_stamp
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.clocks import stamp_ns
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import Media, calibrated

IMAGE = "/knee_gap/image_raw/compressed"
CAMERA_INFO = "/knee_gap/camera_info"
BODY_POSE = "/knee_gap/scope_body/pose"
BODY_POSE_TRUE = "/knee_gap/scope_body/pose_true"
LENS_POSE_TRUE = "/knee_gap/scope_pose_true"

OPTICAL_FRAME = "arthroscope_optical"
PARAMETERS_FILE = "scope.yaml"

# Latency from the exposure of an image, or of the tracker, to the recorder.
IMAGE_LATENCY_NS = 8_000_000
POSE_LATENCY_NS = 3_000_000


@dataclass(frozen=True)
class Sample:
    """One sample of a recording: an image or a pose, whichever field is set."""

    stamp_ns: int
    jpeg: bytes | None = None
    T_world_lens: Array | None = None
    T_world_body: Array | None = None
    T_world_body_true: Array | None = None

    @property
    def record_ns(self) -> int:
        """Time at which a recorder would have received it."""
        return self.stamp_ns + (POSE_LATENCY_NS if self.jpeg is None else IMAGE_LATENCY_NS)


def pose_samples(
    times: Array, T_world_body: Array, T_world_lens: Array, T_body_lens: Array
) -> Iterator[Sample]:
    """The tracker's samples at times (n,) [s]: reported body poses (n, 4, 4) of true lens poses (n, 4, 4).

    The lens on the body is (4, 4), or (n, 4, 4) if the scope rotates in its camera head.
    """
    true = T_world_lens @ inverse(T_body_lens)
    for time, body, body_true in zip(times, T_world_body, true, strict=True):
        yield Sample(stamp_ns(time), T_world_body=body, T_world_body_true=body_true)


def write_recording(path: Path, samples: Iterable[Sample], lens: Lens, metadata: dict[str, str]) -> None:
    """Write a new bag of samples, in the order of their ``record_ns``; camera_info is the calibrated lens.

    The true lens pose is written at the stamp of every image, the body's poses at the tracker's own stamps.
    Raises BagError if the bag cannot be written.
    """
    camera_info = camera_info_message(calibrated(lens))
    with BagWriter(path, metadata=metadata) as bag:
        bag.add_topic(IMAGE, "sensor_msgs/msg/CompressedImage", "sensor")
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", "sensor")
        for topic in (BODY_POSE, BODY_POSE_TRUE, LENS_POSE_TRUE):
            bag.add_topic(topic, "geometry_msgs/msg/PoseStamped", "sensor")
        for sample in samples:
            if sample.jpeg is not None:
                image = blank("sensor_msgs/msg/CompressedImage")
                _stamp(image, sample.stamp_ns, OPTICAL_FRAME)
                image.format = "bgr8; jpeg compressed bgr8"
                image.data = np.frombuffer(sample.jpeg, np.uint8)
                _stamp(camera_info, sample.stamp_ns, OPTICAL_FRAME)
                bag.write(IMAGE, image, sample.record_ns)
                bag.write(CAMERA_INFO, camera_info, sample.record_ns)
            for topic, pose in (
                (LENS_POSE_TRUE, sample.T_world_lens),
                (BODY_POSE, sample.T_world_body),
                (BODY_POSE_TRUE, sample.T_world_body_true),
            ):
                if pose is not None:
                    bag.write(topic, pose_message(pose, sample.stamp_ns), sample.record_ns)


def camera_info_message(lens: Lens) -> Any:
    """The sensor_msgs/CameraInfo of a lens, without stamp: OpenCV's fisheye with no further distortion."""
    message = blank("sensor_msgs/msg/CameraInfo")
    message.header.frame_id = OPTICAL_FRAME
    message.width, message.height = lens.width_px, lens.height_px
    message.distortion_model = "equidistant"
    message.d = np.zeros(4)
    focal, x, y = lens.focal_px, lens.centre_x_px, lens.centre_y_px
    message.k = np.array([focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0])
    message.r = np.eye(3).ravel()
    message.p = np.array([focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0])
    return message


def pose_message(T_world_x: Array, stamp_ns: int) -> Any:
    """The geometry_msgs/PoseStamped of a transform (4, 4) in the frame ``world``."""
    message = blank("geometry_msgs/msg/PoseStamped")
    _stamp(message, stamp_ns, "world")
    position, turn = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = (float(value) for value in T_world_x[:3, 3])
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_xyzw(T_world_x))
    return message


def write_parameters(path: Path, scope: Scope, media: Media) -> None:
    """Write the scope and its media of calibration and use as a ROS parameter file for the nodes."""
    camera = {"camera_info_medium": media.calibrated_in, "medium": media.used_in}
    parameters = {
        "/**/segmentation_node": {"ros__parameters": camera},
        "/**/tracking_node": {"ros__parameters": {**scope.parameters(), "medium": media.used_in}},
    }
    with path.open("w", encoding="utf-8") as file:
        YAML().dump(parameters, file)


def _stamp(message: Any, stamp_ns: int, frame_id: str) -> None:
    set_stamp(message.header, stamp_ns)
    message.header.frame_id = frame_id
