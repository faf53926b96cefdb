"""The fisheye (Kannala-Brandt) model, compiled: bearings are asked for many times an image."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array

STEPS = 4  # of Newton's method, from a table: enough for the last digit


def _radius_of(theta: float, k: Array) -> float:
    """Radius [-] in the image at an angle [rad] from the axis; `k` (4,) are the coefficients."""
    t2 = theta * theta
    return float(theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))))


def _angle_of(radius: float, k: Array, radii: Array, angles: Array) -> float:
    """Inverse of `radius_of`, from a table (n,) of it; NaN where the curve is level."""
    theta = float(np.interp(radius, radii, angles))
    for _ in range(STEPS):
        t2 = theta * theta
        slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        if abs(slope) < 1e-9:
            return np.nan
        theta = theta - (radius_of(theta, k) - radius) / slope
    return theta


def _fisheye_bearings(
    pixels: Array, matrix: Array, k: Array, fold: float, radii: Array, angles: Array, tolerance: float
) -> Array:
    """Unit vectors (n, 3) at pixels (n, 2); NaN from the angle `fold` [rad] on.

    `matrix` is fx, fy, cx, cy [px]; `radii` and `angles` are the table of the curve, empty where there is no
    distortion; `tolerance` [px] bounds the error of the inverse.
    """
    bearings = np.full((pixels.shape[0], 3), np.nan)
    scale = max(matrix[0], matrix[1])
    for n in range(pixels.shape[0]):
        x, y = (pixels[n, 0] - matrix[2]) / matrix[0], (pixels[n, 1] - matrix[3]) / matrix[1]
        radius = np.hypot(x, y)
        if not radius < np.inf:
            continue
        theta = angle_of(radius, k, radii, angles) if radii.size else radius
        if 0.0 <= theta < fold and abs(radius_of(theta, k) - radius) * scale < tolerance:
            share = np.sin(theta) / radius if radius > 0.0 else 1.0
            bearings[n, 0], bearings[n, 1], bearings[n, 2] = x * share, y * share, np.cos(theta)
    return bearings


def _fisheye_pixels(bearings: Array, matrix: Array, k: Array, fold: float) -> Array:
    """Pixels (n, 2) at which directions (n, 3) of any length are seen; NaN from the angle `fold` [rad] on."""
    pixels = np.full((bearings.shape[0], 2), np.nan)
    for n in range(bearings.shape[0]):
        x, y, z = bearings[n]
        side = np.hypot(x, y)
        theta = np.arctan2(side, z)
        if theta < fold and (side > 0.0 or z > 0.0):
            ratio = radius_of(theta, k) / side if side > 0.0 else 0.0
            pixels[n, 0] = x * ratio * matrix[0] + matrix[2]
            pixels[n, 1] = y * ratio * matrix[1] + matrix[3]
    return pixels


radius_of: Callable[[float, Array], float] = compiled(_radius_of)
angle_of: Callable[[float, Array, Array, Array], float] = compiled(_angle_of)
fisheye_bearings: Callable[[Array, Array, Array, float, Array, Array, float], Array] = compiled(
    _fisheye_bearings
)
fisheye_pixels: Callable[[Array, Array, Array, float], Array] = compiled(_fisheye_pixels)
