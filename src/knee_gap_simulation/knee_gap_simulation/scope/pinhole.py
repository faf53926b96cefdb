"""A lens without distortion, for calibrations by the pinhole model."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.scope.lens import Lens


@dataclass(frozen=True)
class PinholeLens(Lens):
    """A bearing at the angle a from the axis falls focal_px * tan(a) from the centre."""

    focal_px: float = 350.0  # px

    @property
    def radius_px(self) -> float:
        """Radius of the circular picture [px]."""
        return float(self.focal_px * np.tan(self.field_of_view / 2.0))

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) of pixels (..., 2) [px]; NaN outside the field of view."""
        offset = np.asarray(pixels, dtype=np.float64) - (self.centre_x_px, self.centre_y_px)
        ray = np.concatenate([offset / self.focal_px, np.ones_like(offset[..., :1])], axis=-1)
        unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        unit[np.hypot(offset[..., 0], offset[..., 1]) > self.radius_px] = np.nan
        return np.asarray(unit)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) of directions (..., 3) of any length; NaN outside the field of view."""
        direction = np.asarray(bearings, dtype=np.float64)
        angle = np.arctan2(np.hypot(direction[..., 0], direction[..., 1]), direction[..., 2])
        with np.errstate(invalid="ignore", divide="ignore"):
            pixel = self.focal_px * direction[..., :2] / direction[..., 2:]
        pixel += np.array([self.centre_x_px, self.centre_y_px])
        pixel[~(angle <= self.field_of_view / 2.0)] = np.nan
        return np.asarray(pixel)
