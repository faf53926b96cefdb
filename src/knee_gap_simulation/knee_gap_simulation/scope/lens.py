"""The simulated lens: an ideal equidistant fisheye behind a circular field stop.

It is independent of the perception's camera models, so that a mistake in those shows against the truth.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError


@dataclass(frozen=True)
class Lens:
    """An equidistant lens: a bearing at the angle a from the axis falls focal_px * a from the centre.

    Frame: optical (z along the view, x right, y down). Pixel (0, 0) is the centre of the first pixel.
    ``field_of_view`` is the full angle [rad] that passes the field stop; the image is black beyond it, and in
    ``cut_top_px`` rows at its top and ``cut_bottom_px`` at its bottom.
    """

    width_px: int = 1280
    height_px: int = 720
    focal_px: float = 360.0 / (np.pi / 4.0)  # px/rad
    centre_x_px: float = 642.6
    centre_y_px: float = 357.8
    field_of_view: float = np.pi / 2.0
    cut_top_px: float = 0.0
    cut_bottom_px: float = 0.0

    def __post_init__(self) -> None:
        if self.width_px < 16 or self.height_px < 16:
            raise SimulationError(
                f"the image must be at least 16 px wide and high, not {self.width_px} x {self.height_px} px"
            )
        if not 0.0 < self.field_of_view < np.pi:
            raise SimulationError(f"field_of_view must lie in (0, pi) rad, not {self.field_of_view}")
        if not self.focal_px > 0.0:
            raise SimulationError(f"focal_px must be positive, not {self.focal_px} px/rad")

    @property
    def radius_px(self) -> float:
        """Radius of the circular picture [px]."""
        return self.focal_px * self.field_of_view / 2.0

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) of pixels (..., 2) [px]; NaN outside the field of view."""
        offset = np.asarray(pixels, dtype=np.float64) - (self.centre_x_px, self.centre_y_px)
        angle = np.hypot(offset[..., 0], offset[..., 1]) / self.focal_px
        # sin(a) / r in a form that needs no special case at the centre.
        scale = np.sinc(angle / np.pi) / self.focal_px
        unit = np.stack([offset[..., 0] * scale, offset[..., 1] * scale, np.cos(angle)], axis=-1)
        unit[~(angle <= self.field_of_view / 2.0) | self._cut(offset[..., 1] + self.centre_y_px)] = np.nan
        return np.asarray(unit)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) of directions (..., 3) of any length; NaN outside the field of view."""
        direction = np.asarray(bearings, dtype=np.float64)
        across = np.hypot(direction[..., 0], direction[..., 1])
        angle = np.arctan2(across, direction[..., 2])
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(across > 0.0, self.focal_px * angle / across, 0.0)
        pixel = direction[..., :2] * scale[..., None] + (self.centre_x_px, self.centre_y_px)
        pixel[~(angle <= self.field_of_view / 2.0) | self._cut(pixel[..., 1])] = np.nan
        return np.asarray(pixel)

    def pixel_grid(self) -> Array:
        """Centres (height, width, 2) of every pixel of the image."""
        x_px, y_px = np.meshgrid(
            np.arange(self.width_px, dtype=float), np.arange(self.height_px, dtype=float)
        )
        return np.stack([x_px, y_px], axis=-1)

    def field_stop(self, softness_px: float = 1.5) -> npt.NDArray[np.float32]:
        """Fraction (height, width) of the light that passes the stop: 1 inside, 0 outside, soft between."""
        offset = self.pixel_grid() - (self.centre_x_px, self.centre_y_px)
        inside = (self.radius_px - np.hypot(offset[..., 0], offset[..., 1])) / softness_px
        inside[self._cut(np.arange(self.height_px, dtype=float))] = 0.0
        return np.clip(inside, 0.0, 1.0).astype(np.float32)

    def reduced(self, factor: float) -> "Lens":
        """The lens on a sensor with this many times fewer rows and columns, of the same field."""
        return replace(
            self,
            width_px=round(self.width_px / factor),
            height_px=round(self.height_px / factor),
            focal_px=self.focal_px / factor,
            centre_x_px=(self.centre_x_px + 0.5) / factor - 0.5,
            centre_y_px=(self.centre_y_px + 0.5) / factor - 0.5,
            cut_top_px=self.cut_top_px / factor,
            cut_bottom_px=self.cut_bottom_px / factor,
        )

    def as_dict(self) -> dict[str, Any]:
        """The lens as plain values for JSON; cuts only if there are any."""
        values = asdict(self)
        return {
            name: value for name, value in values.items() if not (name.startswith("cut") and value == 0.0)
        }

    def _cut(self, rows_px: Array) -> npt.NDArray[np.bool_]:
        """Whether rows (...) [px] lie in the cut parts of the image."""
        if self.cut_top_px == 0.0 and self.cut_bottom_px == 0.0:
            return np.zeros(rows_px.shape, bool)
        last = self.height_px - self.cut_bottom_px - 0.5
        return np.asarray((rows_px < self.cut_top_px - 0.5) | (rows_px > last))
