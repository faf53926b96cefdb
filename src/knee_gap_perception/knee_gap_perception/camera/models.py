"""Camera models: conversion of pixels to directions in the optical frame, and back.

Pixels are (column, row), (0, 0) the centre of the first pixel. The optical frame is REP-103's: z along the
view, x to the right, y down. A pixel or direction outside the model gives NaN.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.camera import (
    Coarseness,
    check_matrix,
    check_size,
    coefficients,
    first_positive_root,
)
from knee_gap_perception.camera.fisheye_kernel import fisheye_bearings, fisheye_pixels
from knee_gap_perception.errors import PerceptionError

PIXEL_TOLERANCE = 1e-6  # [px] largest change of a pixel after conversion to a direction and back
TABLE_SIZE = 2048  # samples of a distortion curve, from which its inverse starts


@dataclass(frozen=True)
class EquiangularCamera(Coarseness):
    """The paper's model: every pixel spans the same angle, its degrees per pixel DPP (section II-E).

    Columns count azimuth about the y axis, rows elevation from the x-z plane:
    bearing = (sin az cos el, sin el, cos az cos el). DPP = field / size in each direction; the paper prints
    0.075 deg/px for 90 / 1280, which is 0.0703.

    Raises PerceptionError for an empty image or a field outside (0, 2 pi] in azimuth or (0, pi] in elevation.
    """

    width_px: int
    height_px: int
    field_azimuth: float = np.pi / 2
    field_elevation: float = np.pi / 2

    def __post_init__(self) -> None:
        check_size(self.width_px, self.height_px)
        if not 0 < self.field_azimuth <= 2 * np.pi or not 0 < self.field_elevation <= np.pi:
            raise PerceptionError(
                "the field of view must lie in (0, 2 pi] rad in azimuth and (0, pi] rad in elevation, "
                f"not {self.field_azimuth} and {self.field_elevation} rad"
            )

    @property
    def _scale(self) -> Array:
        """Radians per pixel of column and row (2,)."""
        return np.array([self.field_azimuth / self.width_px, self.field_elevation / self.height_px])

    @property
    def _centre(self) -> Array:
        return np.array([(self.width_px - 1) / 2, (self.height_px - 1) / 2])

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) seen at pixels (..., 2); NaN beyond a half turn."""
        angles = (np.asarray(pixels, dtype=np.float64) - self._centre) * self._scale
        azimuth, elevation = angles[..., 0], angles[..., 1]
        bearing = np.stack(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)],
            axis=-1,
        )
        inside = (np.abs(azimuth) < np.pi) & (np.abs(elevation) < np.pi / 2)
        return np.where(inside[..., None], bearing, np.nan)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) at which directions (..., 3) are seen; NaN straight up and down."""
        x, y, z = np.moveaxis(np.asarray(bearings, dtype=np.float64), -1, 0)
        level = np.hypot(x, z)
        angles = np.stack([np.arctan2(x, z), np.arctan2(y, level)], axis=-1)
        return np.where((level > 0)[..., None], angles / self._scale + self._centre, np.nan)


@dataclass(frozen=True)
class PinholeCamera(Coarseness):
    """OpenCV's pinhole model, CameraInfo's `plumb_bob` and `rational_polynomial`.

    It takes no, 4, 5 or 8 distortion coefficients, or 12 with the thin prism. Directions at or behind the
    image plane, and beyond the radius at which the distortion folds back on itself, are outside the model.

    Raises PerceptionError for a size, matrix or coefficients that break the model's rules.
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fold_radius: float = field(init=False, repr=False, default=np.inf)

    def __post_init__(self) -> None:
        check_size(self.width_px, self.height_px)
        check_matrix(self.fx, self.fy, self.cx, self.cy)
        given = coefficients(self.distortion, (0, 4, 5, 8, 12), "the pinhole model")
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = given + (0.0,) * (12 - len(given))
        object.__setattr__(self, "distortion", given)
        object.__setattr__(self, "_numerator", np.array([k3, 0, k2, 0, k1, 0, 1]))
        object.__setattr__(self, "_denominator", np.array([k6, 0, k5, 0, k4, 0, 1]))
        object.__setattr__(self, "_tangential", (p1, p2, s1, s2, s3, s4))
        object.__setattr__(self, "fold_radius", self._find_fold())

    _numerator: Array = field(init=False, repr=False, compare=False)
    _denominator: Array = field(init=False, repr=False, compare=False)
    _tangential: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def _find_fold(self) -> float:
        """Radius on the plane z = 1 at which the radial distortion stops growing, or 20 (87 degrees)."""
        curve = np.polymul([1.0, 0.0], self._numerator)
        slope = np.polysub(
            np.polymul(np.polyder(curve), self._denominator), np.polymul(curve, np.polyder(self._denominator))
        )
        limit = first_positive_root(self._denominator, limit=20.0)
        return first_positive_root(slope, limit=limit)

    def _radial(self, r: Array) -> Array:
        return np.asarray(np.polyval(self._numerator, r) / np.polyval(self._denominator, r))

    def _distort(self, plane: Array) -> Array:
        """Distorted points (..., 2) of the plane z = 1."""
        x, y = plane[..., 0], plane[..., 1]
        p1, p2, s1, s2, s3, s4 = self._tangential
        r2 = x * x + y * y
        radial = self._radial(np.sqrt(r2))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
            ],
            axis=-1,
        )

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Distorted radii on the plane z = 1, in order, and the radii that belong to them."""
        radius = np.linspace(0.0, self.fold_radius, TABLE_SIZE)
        return radius * self._radial(radius), radius

    def _undistort(self, target: Array) -> Array:
        """The inverse of `_distort`, by Newton's method from the inverse of the radial part alone."""
        length = np.linalg.norm(target, axis=-1, keepdims=True)
        start = np.interp(length, *self._table)
        plane = target * np.divide(start, length, out=np.ones_like(length), where=length > 0)
        h = 1e-6
        right, down = np.array([h, 0.0]), np.array([0.0, h])
        for _ in range(6):
            dx = (self._distort(plane + right) - self._distort(plane - right)) / (2 * h)
            dy = (self._distort(plane + down) - self._distort(plane - down)) / (2 * h)
            error = self._distort(plane) - target
            determinant = dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]
            determinant = np.where(np.abs(determinant) < 1e-9, np.nan, determinant)
            step_x = (error[..., 0] * dy[..., 1] - error[..., 1] * dy[..., 0]) / determinant
            step_y = (error[..., 1] * dx[..., 0] - error[..., 0] * dx[..., 1]) / determinant
            plane = plane - np.stack([step_x, step_y], axis=-1)
        return np.asarray(plane)

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) seen at pixels (..., 2); NaN outside the model."""
        focal = np.array([self.fx, self.fy])
        target = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / focal
        plane = self._undistort(target) if any(self.distortion) else target
        inside = np.linalg.norm(plane, axis=-1) < self.fold_radius
        inside &= (np.abs(self._distort(plane) - target) * focal < PIXEL_TOLERANCE).all(axis=-1)
        ray = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
        unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        return np.where(inside[..., None], unit, np.nan)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) at which directions (..., 3) are seen; NaN outside the model."""
        ray = np.asarray(bearings, dtype=np.float64)
        depth = np.where(ray[..., 2] > 0, ray[..., 2], np.nan)
        plane = ray[..., :2] / depth[..., None]
        plane = np.where((np.linalg.norm(plane, axis=-1) < self.fold_radius)[..., None], plane, np.nan)
        return self._distort(plane) * [self.fx, self.fy] + [self.cx, self.cy]


@dataclass(frozen=True)
class FisheyeCamera(Coarseness):
    """OpenCV's fisheye (Kannala-Brandt) model, CameraInfo's `equidistant`.

    The radius in the image is theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), theta the angle
    from the optical axis. Unlike OpenCV's own functions it holds beyond 90 degrees from the axis; angles of a
    half turn, or beyond the one at which the polynomial folds back, are outside the model.

    Raises PerceptionError for a size, matrix or coefficients that break the model's rules.
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    fold_angle: float = field(init=False, repr=False, default=np.pi)

    def __post_init__(self) -> None:
        check_size(self.width_px, self.height_px)
        check_matrix(self.fx, self.fy, self.cx, self.cy)
        given = coefficients(self.distortion, (4,), "the fisheye model")
        k1, k2, k3, k4 = given
        object.__setattr__(self, "distortion", given)
        slope = [9 * k4, 0, 7 * k3, 0, 5 * k2, 0, 3 * k1, 0, 1]
        object.__setattr__(self, "fold_angle", first_positive_root(slope, limit=np.pi))

    def _radius(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    @cached_property
    def _matrix(self) -> Array:
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @cached_property
    def _polynomial(self) -> Array:
        return np.array(self.distortion)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Radii in the image, in order, and the angles that belong to them; empty without distortion."""
        theta = np.linspace(0.0, self.fold_angle, TABLE_SIZE if any(self.distortion) else 0)
        return self._radius(theta), theta

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) seen at pixels (..., 2); NaN outside the model."""
        given = np.asarray(pixels, dtype=np.float64)
        flat = np.ascontiguousarray(given.reshape(-1, 2))
        radii, angles = self._table
        found = fisheye_bearings(
            flat, self._matrix, self._polynomial, self.fold_angle, radii, angles, PIXEL_TOLERANCE
        )
        return found.reshape((*given.shape[:-1], 3))

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) at which directions (..., 3) are seen; NaN outside the model."""
        given = np.asarray(bearings, dtype=np.float64)
        flat = np.ascontiguousarray(given.reshape(-1, 3))
        found = fisheye_pixels(flat, self._matrix, self._polynomial, self.fold_angle)
        return found.reshape((*given.shape[:-1], 2))
