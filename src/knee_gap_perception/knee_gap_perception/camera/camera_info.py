"""The camera model that a sensor_msgs/CameraInfo describes."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.models import FisheyeCamera, PinholeCamera
from knee_gap_perception.errors import PerceptionError


class CameraInfo(Protocol):
    """The fields of sensor_msgs/CameraInfo that are used, of ROS's own class or any other."""

    height: int
    width: int
    distortion_model: str
    d: Sequence[float]
    k: Sequence[float]


MODELS: dict[str, Callable[..., Camera]] = {
    "plumb_bob": PinholeCamera,
    "rational_polynomial": PinholeCamera,
    "equidistant": FisheyeCamera,
    "fisheye": FisheyeCamera,
}


def camera_from_info(info: CameraInfo) -> Camera:
    """The camera that a sensor_msgs/CameraInfo describes.

    Raises PerceptionError for an unknown distortion model, an uncalibrated camera, and binned or cropped
    images.
    """
    if info.distortion_model not in MODELS:
        choices = ", ".join(MODELS)
        raise PerceptionError(
            f"camera_info's distortion_model must be one of {choices}, not '{info.distortion_model}'"
        )
    if max(getattr(info, "binning_x", 0), getattr(info, "binning_y", 0)) > 1:
        raise PerceptionError(f"camera_info must not be binned, but has {info.binning_x}x{info.binning_y}")  # type: ignore[attr-defined]
    roi = getattr(info, "roi", None)
    if roi is not None and (roi.x_offset, roi.y_offset) != (0, 0):
        raise PerceptionError(
            "camera_info must describe the whole image, but its region of interest starts at "
            f"({roi.x_offset}, {roi.y_offset}) px"
        )
    k = np.asarray(info.k, dtype=np.float64)
    if k.shape != (9,):
        raise PerceptionError(f"camera_info's k must have 9 entries, not {k.size}")
    fx, fy, cx, cy = float(k[0]), float(k[4]), float(k[2]), float(k[5])
    model = MODELS[info.distortion_model]
    return model(int(info.width), int(info.height), fx, fy, cx, cy, tuple(float(value) for value in info.d))
