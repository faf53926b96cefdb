"""Projection of points to pixels with derivatives, for fits of the lens (OpenCV's projections).

Parameters are one array: fx, fy, cx, cy, then the coefficients of the model. The camera model of a *fitted*
lens, for measurements, is in `knee_gap_perception.camera.models`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

NAMES = {
    "plumb_bob": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
# High-order terms, fixed at 0 by default: a board covers the image too sparsely to determine them.
HIGH_ORDER = {"plumb_bob": ("k3",), "equidistant": ("k3", "k4")}


class Projection(NamedTuple):
    """Pixels (n, 2) and their derivatives by the points (n, 2, 3) [px/m] and by the parameters (n, 2, m)."""

    pixels: Array
    by_point: Array
    by_parameter: Array


@dataclass(frozen=True)
class LensModel:
    """A distortion model of sensor_msgs/CameraInfo and its free parameters in a fit."""

    distortion_model: str
    high_order: bool = False

    def __post_init__(self) -> None:
        if self.distortion_model not in NAMES:
            choices = ", ".join(NAMES)
            raise PerceptionError(f"the lens model must be one of {choices}, not '{self.distortion_model}'")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return NAMES[self.distortion_model]

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        """Which parameters a fit changes (m,)."""
        fixed = () if self.high_order else HIGH_ORDER[self.distortion_model]
        return np.array([name not in fixed for name in self.names])

    def start(self, width_px: int, height_px: int, focal_px: float) -> Array:
        """Parameters (m,) of an undistorted lens that looks through the centre of the image."""
        values = np.zeros(len(self.names))
        values[:4] = focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2
        return values

    def project(self, points: Array, parameters: Array) -> Projection:
        """Project points (n, 3) [m] in the optical frame."""
        K, d = _matrix(parameters), parameters[4:]
        zero = np.zeros(3)
        if self.distortion_model == "equidistant":
            pixels, jacobian = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, d)
            by_point, by_parameter = jacobian[:, 11:14], jacobian[:, :8]
        else:
            pixels, jacobian = cv2.projectPoints(points[:, None], zero, zero, K, d)
            by_point, by_parameter = jacobian[:, 3:6], jacobian[:, 6:]
        count = len(points)
        return Projection(
            np.asarray(pixels.reshape(count, 2), dtype=np.float64),
            np.asarray(by_point.reshape(count, 2, 3), dtype=np.float64),
            np.asarray(by_parameter.reshape(count, 2, len(self.names)), dtype=np.float64),
        )

    def plane(self, pixels: Array, parameters: Array) -> Array:
        """Points (n, 2) of the plane z = 1 behind pixels (n, 2)."""
        K, d = _matrix(parameters), parameters[4:]
        if self.distortion_model == "equidistant":
            return np.asarray(cv2.fisheye.undistortPoints(pixels[:, None], K, d)[:, 0], dtype=np.float64)
        return np.asarray(cv2.undistortPoints(pixels[:, None], K, d)[:, 0], dtype=np.float64)


def _matrix(parameters: Array) -> Array:
    fx, fy, cx, cy = parameters[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
