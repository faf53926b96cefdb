"""Media in front of the lens: a lens that is calibrated in one and used in another (air, saline, water).

It is independent of the perception, as `lens` is, so that a mistake there shows against the ground truth.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.scope.lens import Lens

Medium = str | float
INDICES = {"air": 1.0, "saline": 1.336, "water": 1.333}


class Media(NamedTuple):
    """Media in which a lens was calibrated and is used: names of INDICES, or refractive indices."""

    calibrated_in: Medium
    used_in: Medium

    @property
    def ratio(self) -> float:
        """Ratio of the sine of an angle in use to that at the calibration."""
        return index_of(self.calibrated_in) / index_of(self.used_in)


IN_SALINE = Media("saline", "saline")


def index_of(medium: Medium) -> float:
    """Refractive index of a medium. Raises SimulationError for an unknown medium."""
    if isinstance(medium, str) and medium in INDICES:
        return INDICES[medium]
    try:
        index = float(medium)
    except ValueError:
        index = float("nan")
    if not 1.0 <= index <= 1.6:
        choices = ", ".join(INDICES)
        raise SimulationError(f"a medium must be {choices} or an index in [1, 1.6], not '{medium}'")
    return index


@dataclass(frozen=True)
class RefractedLens(Lens):
    """A lens behind a flat window across its axis: sin(angle) = ratio * sin(angle of `inner`) (Snell).

    Its image is as large as that of `inner`, and shows a smaller field if the ratio is below 1.
    """

    inner: Lens = field(default_factory=Lens)
    ratio: float = 1.0

    @staticmethod
    def of(inner: Lens, ratio: float) -> Lens:
        """`inner` with the sines of all angles multiplied by `ratio`; itself for 1."""
        if ratio == 1.0:
            return inner
        side = ratio * np.sin(inner.field_of_view / 2.0)
        if side >= 1.0:
            raise SimulationError("total reflection at the border of the field: choose another medium")
        return RefractedLens(
            width_px=inner.width_px,
            height_px=inner.height_px,
            focal_px=inner.focal_px / ratio,
            centre_x_px=inner.centre_x_px,
            centre_y_px=inner.centre_y_px,
            field_of_view=2.0 * float(np.arcsin(side)),
            cut_top_px=inner.cut_top_px,
            cut_bottom_px=inner.cut_bottom_px,
            inner=inner,
            ratio=ratio,
        )

    @property
    def radius_px(self) -> float:
        """Radius of the circular picture [px]."""
        return self.inner.radius_px

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) of pixels (..., 2) [px]; NaN outside the field of view."""
        return _bent(self.inner.bearings(pixels), self.ratio)

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) of directions (..., 3) of any length; NaN outside the field of view."""
        return self.inner.pixels(_bent(np.asarray(bearings, dtype=np.float64), 1.0 / self.ratio))


def calibrated(lens: Lens) -> Lens:
    """The lens in the medium of its calibration."""
    return lens.inner if isinstance(lens, RefractedLens) else lens


def _bent(directions: Array, ratio: float) -> Array:
    """Unit vectors (..., 3) after the window: azimuths stay, sines of angles to the axis are scaled."""
    across = np.hypot(directions[..., 0], directions[..., 1])
    angle = np.arctan2(across, directions[..., 2])
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    with np.errstate(invalid="ignore"):
        after = np.arcsin(np.where(angle < np.pi / 2.0, ratio * np.sin(angle), np.nan))
    return np.stack(
        [np.sin(after) * np.cos(azimuth), np.sin(after) * np.sin(azimuth), np.cos(after)], axis=-1
    )
