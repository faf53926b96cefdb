"""A confidence interval of the gap: extremes of the distance over the confidence ellipsoid of both points.

The ellipsoid lies in direction and inverse depth, where the likelihood is near Gaussian down to small
parallax; the distance is not linear there, so the interval is asymmetric and its upper end is infinite as
soon as the ellipsoid reaches infinity. `docs/coverage.md` shows how often it holds the truth.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from knee_gap_uncertainty.compiled import compiled
from knee_gap_uncertainty.errors import BadInputError
from knee_gap_uncertainty.multi_view import MultiViewFit
from knee_gap_uncertainty.small_matrix import cholesky, solve_factored

Array = npt.NDArray[np.float64]

# Relative standard deviation of inverse depth beyond which no interval is given.
LARGEST_INVERSE_DEPTH_VARIATION = 0.15

ASCENT_STEPS = 60
DESCENT_STEPS = 30


@dataclass(frozen=True)
class ConfidenceInterval:
    """Where the gap lies in a share `level` of cases [m].

    `upper` is infinite where the data do not bound the gap. `refused` says that the parallax is too small for
    the level to hold, and `reason` why; `lower` is then still a bound, `upper` is infinite.
    """

    lower: float
    upper: float
    level: float
    refused: bool
    reason: str = ""


def confidence_interval(fit: MultiViewFit, level: float = 0.95) -> ConfidenceInterval:
    """Interval of the gap at a confidence level in (0, 1).

    Refused where the larger relative error of the two inverse depths is above 0.15. Raises BadInputError for
    a level that is not inside (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise BadInputError(f"the confidence level must lie inside (0, 1), not {level!r}")
    lower, upper = distance_extremes(
        fit.frames, fit.unknowns, fit.unknowns_covariance, float(norm.ppf(0.5 + 0.5 * level))
    )
    variation = fit.inverse_depth_variation
    if variation > LARGEST_INVERSE_DEPTH_VARIATION:
        reason = (
            f"relative error of inverse depth {variation:.2f} above {LARGEST_INVERSE_DEPTH_VARIATION}: "
            "the scope has to move further"
        )
        return ConfidenceInterval(lower, float("inf"), level, refused=True, reason=reason)
    return ConfidenceInterval(lower, upper, level, refused=False)


@compiled
def distance_extremes(
    frames: Array, unknowns: Array, covariance: Array, radius: float
) -> tuple[float, float]:
    """Smallest and largest distance [m] of the points over an ellipsoid of `radius` standard deviations.

    `unknowns` (2, 3) and `covariance` (6, 6) as in MultiViewFit. The largest is infinite where the ellipsoid
    reaches an inverse depth of 0.
    """
    factor = np.zeros((6, 6))
    if not cholesky(covariance, factor):
        return 0.0, np.inf
    for row in range(6):
        for column in range(6):
            factor[row, column] *= radius
    lower = _smallest_distance(frames, unknowns, factor)
    for n in range(2):
        k = 3 * n + 2
        if unknowns[n, 2] - radius * np.sqrt(covariance[k, k]) <= 0.0:
            return lower, np.inf
    return lower, max(_largest_distance(frames, unknowns, factor), lower)


@compiled
def _difference(
    frames: Array, unknowns: Array, factor: Array, unit: Array, apart: Array, slope: Array
) -> bool:
    """Write G_1 - G_0 at unknowns + factor @ unit, and its (3, 6) slope by `unit`; false at infinity."""
    apart[:] = 0.0
    slope[:, :] = 0.0
    place = np.zeros(3)
    for n in range(2):
        sign = 2.0 * n - 1.0
        for k in range(3):
            place[k] = unknowns[n, k]
            for column in range(3 * n + k + 1):
                place[k] += factor[3 * n + k, column] * unit[column]
        rho = place[2]
        if not rho > 1e-6:
            return False
        for k in range(3):
            direction = frames[n, 0, k] + place[0] * frames[n, 1, k] + place[1] * frames[n, 2, k]
            apart[k] += sign * direction / rho
            for column in range(3 * n + 3):
                change = (
                    frames[n, 1, k] * factor[3 * n, column]
                    + frames[n, 2, k] * factor[3 * n + 1, column]
                    - direction / rho * factor[3 * n + 2, column]
                )
                slope[k, column] += sign * change / rho
    return True


@compiled
def _largest_distance(frames: Array, unknowns: Array, factor: Array) -> float:
    """Fixed-point ascent of the distance over the ellipsoid's surface.

    It starts along the present difference and, because a gap of the size of its error can grow to either
    side, along both senses of each axis of space.
    """
    unit = np.zeros(6)
    apart = np.zeros(3)
    slope = np.zeros((3, 6))
    towards = np.zeros((7, 3))
    best = 0.0
    if not _difference(frames, unknowns, factor, unit, apart, slope):
        return np.inf
    towards[0] = apart
    for axis in range(3):
        for k in range(3):
            towards[1 + 2 * axis, k] = frames[0, axis, k]
            towards[2 + 2 * axis, k] = -frames[0, axis, k]
    slope_at_centre = slope.copy()
    for first in range(7):
        aim = towards[first].copy()
        slope[:, :] = slope_at_centre
        previous = 0.0
        for _ in range(ASCENT_STEPS):
            length = 0.0
            for column in range(6):
                value = 0.0
                for k in range(3):
                    value += slope[k, column] * aim[k]
                unit[column] = value
                length += value * value
            length = np.sqrt(length)
            if not length > 0.0:
                break
            for column in range(6):
                unit[column] /= length
            if not _difference(frames, unknowns, factor, unit, apart, slope):
                return np.inf
            distance = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
            best = max(best, distance)
            if abs(distance - previous) <= 1e-9 * distance:
                break
            previous = distance
            aim[:] = apart
    return best


@compiled
def _smallest_distance(frames: Array, unknowns: Array, factor: Array) -> float:
    """Gauss-Newton of the difference to zero, each step the best one inside the ellipsoid."""
    unit = np.zeros(6)
    trial = np.zeros(6)
    apart = np.zeros(3)
    slope = np.zeros((3, 6))
    if not _difference(frames, unknowns, factor, unit, apart, slope):
        return 0.0
    best = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
    target = np.zeros(3)
    share = 1.0
    for _ in range(DESCENT_STEPS):
        for k in range(3):
            target[k] = -apart[k]
            for column in range(6):
                target[k] += slope[k, column] * unit[column]
        _nearest_inside(slope, target, trial)
        share = 1.0
        improved = False
        for _ in range(6):
            for column in range(6):
                trial[column] = unit[column] + share * (trial[column] - unit[column])
            inside = _difference(frames, unknowns, factor, trial, apart, slope)
            distance = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
            if inside and distance < best:
                improved = True
                break
            share = 0.5
        if not improved or best - distance <= 1e-9 * best:
            best = min(best, distance) if improved else best
            break
        best = distance
        unit[:] = trial
    return float(best)


@compiled
def _nearest_inside(slope: Array, target: Array, unit: Array) -> None:
    """Write the `unit` of length at most 1 whose slope @ unit is nearest to the target (secular equation)."""
    gram = np.zeros((3, 3))
    damped = np.zeros((3, 3))
    factor = np.zeros((3, 3))
    weights = np.zeros(3)
    again = np.zeros(3)
    for row in range(3):
        for column in range(3):
            for k in range(6):
                gram[row, column] += slope[row, k] * slope[column, k]
    trace = gram[0, 0] + gram[1, 1] + gram[2, 2]
    damping = 1e-12 * trace
    for _ in range(40):
        damped[:, :] = gram
        for k in range(3):
            damped[k, k] += damping
        if not cholesky(damped, factor):
            damping = max(10.0 * damping, 1e-9 * trace)
            continue
        solve_factored(factor, target, weights)
        squared = 0.0
        for column in range(6):
            value = 0.0
            for k in range(3):
                value += slope[k, column] * weights[k]
            unit[column] = value
            squared += value * value
        length = np.sqrt(squared)
        if length <= 1.0 + 1e-10:
            return
        # Newton's step on 1 / |unit| - 1, whose graph over the damping is nearly straight.
        solve_factored(factor, weights, again)
        inner = 0.0
        for row in range(3):
            for column in range(3):
                inner += weights[row] * gram[row, column] * again[column]
        damping += (length - 1.0) * squared / max(inner, 1e-300)
    for column in range(6):
        unit[column] /= max(length, 1.0)
