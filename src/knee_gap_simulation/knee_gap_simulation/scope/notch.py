"""The notch of the field stop: a black triangle at the border of the image that points inwards."""

import numpy as np
import numpy.typing as npt

from knee_gap_simulation.scope.lens import Lens

HALF_WIDTH = np.radians(2.6)
DEPTH = 0.055  # of the field's radius


class Notch:
    """Fraction of the light that passes the notch, in a box (rows, columns) of the image of a lens."""

    def __init__(self, lens: Lens, box: tuple[slice, slice]) -> None:
        offset = (lens.pixel_grid()[box] - (lens.centre_x_px, lens.centre_y_px)).astype(np.float32)
        self._radius_px = np.float32(lens.radius_px)
        self._radius = np.hypot(offset[..., 0], offset[..., 1]) / self._radius_px
        self._angle = np.arctan2(offset[..., 1], offset[..., 0])

    def light(self, angle: float) -> npt.NDArray[np.float32]:
        """Fraction (h, w) with the notch at an angle [rad] in the image, from x towards y."""
        away = (self._angle - angle + np.pi) % (2 * np.pi) - np.pi
        height = DEPTH * (1 - np.abs(away) / HALF_WIDTH)
        inside = (1 - height - self._radius) * self._radius_px
        return np.where(height > 0, np.clip(inside + 0.5, 0, 1), 1).astype(np.float32)
