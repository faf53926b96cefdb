"""Two views of the two points of the gap: checked once, where they enter the analysis."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.errors import BadInputError, BaselineTooShortError

# Bearings come through float32 messages and camera models: this is rounding, not a wrong vector.
UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class TwoViews:
    """Lens positions A0, A1 (3,) [m] and unit vectors (2, 3) from each to the points G0, G1, in one frame."""

    lens_0: npt.NDArray[np.float64]
    lens_1: npt.NDArray[np.float64]
    bearings_0: npt.NDArray[np.float64]
    bearings_1: npt.NDArray[np.float64]

    @property
    def travel(self) -> npt.NDArray[np.float64]:
        """Translation t = A1 - A0 (3,) [m]."""
        return self.lens_1 - self.lens_0

    @property
    def baseline(self) -> float:
        """Length of the travel |t| [m]."""
        return float(np.linalg.norm(self.travel))


def two_views(
    lens_0: npt.ArrayLike, lens_1: npt.ArrayLike, bearings_0: npt.ArrayLike, bearings_1: npt.ArrayLike
) -> TwoViews:
    """Check and pack two views.

    Raises BadInputError for a wrong shape, a value that is not finite or a bearing that is no unit vector,
    and BaselineTooShortError for lens positions that are equal.
    """
    views = TwoViews(
        finite("lens_0", lens_0, (3,)),
        finite("lens_1", lens_1, (3,)),
        unit_vectors("bearings_0", bearings_0),
        unit_vectors("bearings_1", bearings_1),
    )
    if not views.baseline > 0:
        raise BaselineTooShortError("lens_0 and lens_1 are equal: the lens must have moved between the views")
    if not math.isfinite(views.baseline):
        raise BadInputError("lens_0 and lens_1 must be a finite distance apart [m]")
    return views


def finite(name: str, value: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """The value as an array of that shape; BadInputError names what is wrong with it.

    Always a copy in C order: kernels are compiled for that, and would be again, in flight, for a view or a
    read-only array.
    """
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise BadInputError(f"{name} must be numbers of shape {shape}, got {value!r}") from None
    if array.shape != shape:
        raise BadInputError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise BadInputError(f"{name} must be finite, got {array.tolist()}")
    return array


def unit_vectors(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The value as (2, 3) unit vectors; BadInputError names the first that is not one."""
    bearings = finite(name, value, (2, 3))
    for n, length in enumerate(np.sqrt((bearings**2).sum(axis=1))):
        if not abs(length - 1) <= UNIT_TOLERANCE:
            raise BadInputError(
                f"{name}[{n}] must be a unit vector to {UNIT_TOLERANCE:g}, its length is {length:.9g}"
            )
    return bearings
