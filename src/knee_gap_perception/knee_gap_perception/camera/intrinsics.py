"""Intrinsics of a calibrated lens: focal lengths, principal point, distortion, and their covariance."""

from dataclasses import dataclass

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.camera_info import MODELS


@dataclass(frozen=True)
class Intrinsics:
    """A fitted lens; it has the fields of sensor_msgs/CameraInfo that `camera_from_info` reads.

    `covariance` (m, m) is of fx, fy, cx, cy [px] and `d`, in this order; rows of fixed parameters are 0.
    `rms_px` is the RMS distance of a point, `sigma_px` the standard deviation of one coordinate.
    `design_effect` is the number of neighbouring points that count as one, because deviations from the model
    move them together; the covariance includes it.
    """

    width: int
    height: int
    distortion_model: str
    k: tuple[float, ...]
    d: tuple[float, ...]
    covariance: Array
    rms_px: float
    sigma_px: float
    design_effect: float
    view_count: int
    point_count: int

    @property
    def parameters(self) -> Array:
        """fx, fy, cx, cy and the distortion (m,)."""
        return np.array([self.k[0], self.k[4], self.k[2], self.k[5], *self.d])

    def camera(self) -> Camera:
        """The camera model that measures with this lens."""
        fx, fy, cx, cy = (float(value) for value in self.parameters[:4])
        return MODELS[self.distortion_model](self.width, self.height, fx, fy, cx, cy, self.d)
