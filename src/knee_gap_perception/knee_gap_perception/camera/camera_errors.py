"""Systematic errors of a camera in use: displacements of a bearing by errors that all images share.

They come from the intrinsics and, if the camera was calibrated in another medium than it is used in, from the
window: the medium's index, the window's tilt and curvature, and the pupil behind it.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.medium import Medium
from knee_gap_perception.camera.refraction import camera_in_medium, refracted

MOST_ERRORS = 9  # independent errors that knee_gap_msgs/GapEdges holds
# Standard deviations of the window's tilt about each image axis [rad] (windows are cemented to some tenths of
# a degree), and of its curvature [1/m] (a sag of 6 um over 3 mm).
WINDOW_TILT = np.radians(0.5)
WINDOW_CURVATURE = 1.0 / 0.2
# RMS distance from the window back to the entrance pupil [m]: it is unknown, and at most about 1.5 mm.
PUPIL_DEPTH = 0.75e-3
# Distance for the effect of a pupil that moves with the angle [m]: gaps are 8-15 mm away, worst if near.
NEAR = 0.008
GRID = 15  # points across the field of view at which errors are compared


class ErrorSource(Protocol):
    """Interface of the independent errors of the intrinsics."""

    def of(self, bearings: Array) -> Array:
        """Displacements (n, 3, k) [rad] of bearings (n, 3) by one standard deviation of each error."""


class WindowErrors:
    """Deviations from Snell's law at a perfect window, from the calibration's medium to that in use."""

    def __init__(self, calibrated_in: Medium, use: Medium) -> None:
        self._ratio = calibrated_in.ratio_to(use)
        self._ratio_error = calibrated_in.ratio_error_to(use)

    def of(self, bearings: Array) -> Array:
        """Displacements (n, 3, 5) [rad], in use, of bearings (n, 3) at the calibration.

        In order: due to the index, the window's tilt about y and about x, its curvature, and the pupil.
        """
        zero = np.zeros((len(bearings), 2))
        axis = np.array([0.0, 0.0, 1.0])
        in_use = refracted(bearings, self._ratio)
        step = 1.0 + self._ratio_error
        by_index = (refracted(bearings, self._ratio * step) - refracted(bearings, self._ratio / step)) / 2.0
        by_tilt = [self._tilted(bearings, zero + WINDOW_TILT * np.eye(2)[k]) for k in (0, 1)]
        # A ray at the angle a meets the window PUPIL_DEPTH tan(a) from its middle.
        off_middle = PUPIL_DEPTH * bearings[:, :2] / bearings[:, 2:]
        by_curvature = self._tilted(bearings, WINDOW_CURVATURE * off_middle)
        # The rays of a pupil behind the window appear to come from a depth that depends on the angle:
        # PUPIL_DEPTH tan(a) / tan(a in use). The part common to all angles shifts the lens, not a bearing.
        paraxial = 1.0 / self._ratio
        recedes = PUPIL_DEPTH * (in_use[:, 2] / bearings[:, 2] / self._ratio - paraxial)
        across = axis - in_use[:, 2:] * in_use
        by_pupil = -recedes[:, None] / NEAR * across
        return np.stack([by_index, *by_tilt, by_curvature, by_pupil], axis=-1)

    def _tilted(self, bearings: Array, tilt: Array) -> Array:
        """Half of the difference (n, 3) between normals that lean by `tilt` (n, 2) [rad] and against it."""
        return (self._through(bearings, tilt) - self._through(bearings, -tilt)) / 2.0

    def _through(self, bearings: Array, tilt: Array) -> Array:
        """Directions in use (n, 3) through a window whose normal leans by `tilt` (n, 2) [rad]."""
        normal = np.concatenate([tilt, np.ones((len(tilt), 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        towards = (bearings * normal).sum(axis=1, keepdims=True)
        along = self._ratio * (bearings - towards * normal)
        square = 1.0 - (along**2).sum(axis=1, keepdims=True)
        return np.asarray(along + np.sqrt(np.where((square > 0) & (towards > 0), square, np.nan)) * normal)


def pupil_shift(calibrated_in: Medium, use: Medium) -> float:
    """Standard deviation [m] of the shift of the lens along its view between two media.

    The image of the pupil, at an unknown distance behind the window, moves with the index in front of it.
    """
    return PUPIL_DEPTH * abs(1.0 / calibrated_in.ratio_to(use) - 1.0)


class CameraErrors:
    """Independent errors of a camera in use, at most nine, and their effect on bearings in use.

    `camera` is the calibrated camera, in the medium `calibrated_in`; `sources` are the errors of its
    intrinsics, as angles in that medium.
    """

    def __init__(
        self, camera: Camera, sources: Sequence[ErrorSource], calibrated_in: Medium, use: Medium
    ) -> None:
        self._sources = tuple(sources)
        self._ratio = calibrated_in.ratio_to(use)
        self._window = WindowErrors(calibrated_in, use) if calibrated_in != use else None
        self._mixed: Array | None = None
        picture = self._all(_over_picture(camera_in_medium(camera, self._ratio)))
        if picture.shape[-1] > MOST_ERRORS:
            self._mixed = _mixture(picture)

    def of(self, bearings: Array) -> Array:
        """Displacements (n, 3, k) [rad] of bearings (n, 3) in use; k is 0 if no error is known."""
        moved = self._all(bearings)
        return moved if self._mixed is None else np.asarray(moved @ self._mixed)

    def _all(self, bearings: Array) -> Array:
        if self._window is None:
            parts = [source.of(bearings) for source in self._sources]
            return np.concatenate(parts, axis=-1) if parts else np.zeros((len(bearings), 3, 0))
        calibrated = refracted(bearings, 1.0 / self._ratio)
        carried = [self._carried(bearings, source.of(calibrated)) for source in self._sources]
        return np.concatenate([*carried, self._window.of(calibrated)], axis=-1)

    def _carried(self, bearings: Array, moved: Array) -> Array:
        """Displacements (n, 3, k) at the calibration, converted to those of the bearings (n, 3) in use."""
        side = self._ratio * moved[:, :2]
        ahead = -np.einsum("ni,nik->nk", bearings[:, :2], side) / bearings[:, 2:]
        return np.concatenate([side, ahead[:, None]], axis=1)


def _over_picture(camera: Camera) -> Array:
    """Bearings (n, 3) over a disc as high as the image, without those outside the model."""
    centre = np.array([camera.width_px - 1.0, camera.height_px - 1.0]) / 2.0
    radius = min(camera.width_px, camera.height_px) / 2.0
    side = np.linspace(-radius, radius, GRID)
    offset = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    bearings = camera.bearings(centre + offset[np.linalg.norm(offset, axis=1) <= radius])
    return np.asarray(bearings[np.isfinite(bearings).all(axis=1)])


def _mixture(picture: Array) -> Array:
    """Matrix (k, MOST_ERRORS) that reduces k independent errors of bearings (n, 3, k) to fewer.

    The largest principal errors are kept. The variance of the others is added to the last, so that the
    variance over the field of view stays the same.
    """
    count = picture.shape[-1]
    finite = picture[np.isfinite(picture).all(axis=(1, 2))].reshape(-1, count)
    # Rows of zeros, if there are too few directions.
    _, sizes, axes = np.linalg.svd(np.concatenate([finite, np.zeros((count, count))]), full_matrices=False)
    mixed = axes[:MOST_ERRORS].T.copy()
    rest = np.linalg.norm(sizes[MOST_ERRORS - 1 :])
    mixed[:, -1] *= rest / max(sizes[MOST_ERRORS - 1], 1e-300)
    return np.asarray(mixed)
