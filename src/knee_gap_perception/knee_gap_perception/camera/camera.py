"""Interface of a camera model, and what all models share: the span of a pixel, the checks of numbers."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

# Largest coefficient, focal length and centre [-, px]: larger ones are not plausible, and products overflow.
LARGEST_NUMBER = 1e6
SHORTEST_FOCAL = 1e-3  # [px]
NO_TERM = 1e-30  # [-] relative to a polynomial's largest term: smaller terms are ignored


class Camera(Protocol):
    """Interface of a camera model."""

    def __hash__(self) -> int:
        """As of any value that does not change."""

    @property
    def width_px(self) -> int:
        """Columns of the image."""

    @property
    def height_px(self) -> int:
        """Rows of the image."""

    def bearings(self, pixels: npt.ArrayLike) -> Array:
        """Unit vectors (..., 3) seen at pixels (..., 2); NaN outside the model."""

    def pixels(self, bearings: npt.ArrayLike) -> Array:
        """Pixels (..., 2) at which directions (..., 3) of any length are seen; NaN outside the model."""

    def radians_per_pixel(self, pixel: npt.ArrayLike) -> float:
        """Angle [rad] that one pixel spans at a pixel (2,), along the coarser direction; NaN outside."""


def bearing_jacobian(camera: Camera, pixel: npt.ArrayLike) -> Array:
    """Change of the bearing with the pixel (3, 2) [1/px] at a pixel (2,), by central differences."""
    u, v = np.asarray(pixel, dtype=np.float64)
    step = 0.25
    b = camera.bearings(np.array([[u + step, v], [u - step, v], [u, v + step], [u, v - step]]))
    return np.ascontiguousarray((b[::2] - b[1::2]).T) / (2 * step)


class Coarseness:
    """Angle spanned by a pixel, computed in the same way for every model."""

    def radians_per_pixel(self: Camera, pixel: npt.ArrayLike) -> float:
        """Angle [rad] that one pixel spans at a pixel (2,), along the coarser direction; NaN outside."""
        jacobian = bearing_jacobian(self, pixel)
        if not np.isfinite(jacobian).all():
            return float("nan")
        # The larger singular value of a matrix (3, 2), without the price of a decomposition.
        (a, b), (_, c) = (jacobian.T @ jacobian).tolist()
        return float(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


def check_size(width_px: int, height_px: int) -> None:
    """Raise PerceptionError for an image without pixels."""
    if width_px < 1 or height_px < 1:
        raise PerceptionError(f"an image must have at least 1x1 px, not {width_px}x{height_px} px")


def check_matrix(fx: float, fy: float, cx: float, cy: float) -> None:
    """Raise PerceptionError for focal lengths or a centre [px] that are not plausible."""
    if not np.isfinite([fx, fy, cx, cy]).all():
        raise PerceptionError(f"the camera matrix must be finite, not fx={fx}, fy={fy}, cx={cx}, cy={cy} px")
    if fx <= 0 or fy <= 0:
        raise PerceptionError(
            f"focal lengths must be above 0 px, not fx={fx}, fy={fy} px (0 stands for an uncalibrated camera)"
        )
    if min(fx, fy) < SHORTEST_FOCAL or max(np.abs([fx, fy, cx, cy])) > LARGEST_NUMBER:
        raise PerceptionError(
            f"the camera matrix must hold focal lengths in [{SHORTEST_FOCAL:g}, {LARGEST_NUMBER:g}] px and a "
            f"centre within {LARGEST_NUMBER:g} px, not fx={fx}, fy={fy}, cx={cx}, cy={cy} px"
        )


def coefficients(distortion: Sequence[float], allowed: tuple[int, ...], model: str) -> tuple[float, ...]:
    """Distortion coefficients as numbers. Raises PerceptionError for another count, or implausible ones."""
    values = tuple(float(value) for value in distortion)
    if len(values) not in allowed:
        choices = ", ".join(map(str, allowed))
        raise PerceptionError(f"{model} takes {choices} distortion coefficients, not {len(values)}")
    if not np.isfinite(values).all():
        raise PerceptionError(f"distortion coefficients must be finite, not {values}")
    if any(abs(value) > LARGEST_NUMBER for value in values):
        raise PerceptionError(
            f"distortion coefficients must lie within {LARGEST_NUMBER:g} of 0, not {values}"
        )
    return values


def first_positive_root(coefficients: npt.ArrayLike, limit: float) -> float:
    """Smallest positive real root of a polynomial, highest power first; `limit` if none is below it."""
    polynomial = np.asarray(coefficients, dtype=np.float64)
    # A term that has no effect below the limit is left out: its roots would overflow.
    terms = np.abs(polynomial) * limit ** np.arange(len(polynomial) - 1, -1, -1)
    polynomial = np.where(terms > NO_TERM * terms.max(), polynomial, 0.0)
    roots = np.roots(polynomial)
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(min(real.min(initial=limit), limit))
