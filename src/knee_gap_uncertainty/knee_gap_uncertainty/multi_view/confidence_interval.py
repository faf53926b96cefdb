"""A confidence interval of the gap: extremes of the distance over the confidence ellipsoid of both points.

The ellipsoid lies in direction and inverse depth, where the likelihood is near Gaussian down to small
parallax; the distance is not linear there, so the interval is asymmetric and its upper end is infinite as
soon as the ellipsoid reaches infinity. `docs/results/coverage.md` shows how often it holds the truth.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.multi_view.common_offset import Bend, gap_of
from knee_gap_uncertainty.multi_view.curvature_correction import radius_at
from knee_gap_uncertainty.multi_view.ellipsoid_distance import largest_distance, smallest_distance
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.numerics.small_matrix import cholesky

# Relative standard deviation of inverse depth beyond which no interval is given.
LARGEST_INVERSE_DEPTH_VARIATION = 0.15

# Turns in which the radius and the place it is for are brought together.
RADIUS_TURNS = 12
RADIUS_TOLERANCE = 5e-3


@dataclass(frozen=True)
class ConfidenceInterval:
    """Where the gap lies in a share `level` of cases [m].

    `upper` is infinite where the data do not bound the gap. `refused` is whether the parallax is too small
    for the level to hold, and `reason` why; `lower` is then still a bound, `upper` is infinite.
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
    lower, upper = interval_ends(
        fit.frames, fit.unknowns, fit.unknowns_covariance, float(ndtri(0.5 + 0.5 * level)), fit.bend
    )
    variation = fit.inverse_depth_variation
    if not variation <= LARGEST_INVERSE_DEPTH_VARIATION:
        reason = (
            f"relative error of inverse depth {variation:.2f} above {LARGEST_INVERSE_DEPTH_VARIATION}: "
            "the scope has to move further"
        )
        return ConfidenceInterval(lower, float("inf"), level, refused=True, reason=reason)
    return ConfidenceInterval(lower, upper, level, refused=False)


@compiled
def interval_ends(
    frames: Array, unknowns: Array, covariance: Array, radius: float, bend: Bend
) -> tuple[float, float]:
    """Lower and upper end [m] at the level whose two-sided normal deviate is `radius`.

    `unknowns` (2, 3), `covariance` (6, 6) and `bend` as in MultiViewFit. The upper end is infinite where the
    ellipsoid reaches an inverse depth of 0.
    """
    lower, upper = _ends_of_ellipsoid(frames, unknowns, covariance, radius * bend.widening)
    move = bend.mean + (radius * radius - 1.0) * bend.skew
    if move == 0.0 or not (unknowns[0, 2] > 0.0 and unknowns[1, 2] > 0.0):
        return lower, upper
    # The ends may not pass the gap. An ellipsoid that holds both points at one place does not limit how far
    # they are apart at least.
    gap = gap_of(frames, unknowns)
    lower = min(max(lower + move, 0.0), gap) if lower > 0.0 else 0.0
    return lower, max(upper + move, gap)


@compiled
def _ends_of_ellipsoid(
    frames: Array, unknowns: Array, covariance: Array, radius: float
) -> tuple[float, float]:
    """Ends [m] over the ellipsoid, by the test that knows how curved the distance is there."""
    root = np.zeros((6, 6))
    if not cholesky(covariance, root):
        return 0.0, np.inf
    unit = np.zeros(6)
    apart = np.zeros(3)
    slope = np.zeros((3, 6))
    lower = 0.0
    used = radius
    for _ in range(RADIUS_TURNS):
        lower = smallest_distance(frames, unknowns, used * root, unit, apart, slope)
        if not lower > 0.0:
            break
        changed = _radius_there(unknowns, root, used, unit, apart, slope, radius)
        if abs(changed - used) < RADIUS_TOLERANCE:
            break
        used = changed
    used = radius
    for _ in range(RADIUS_TURNS):
        upper = largest_distance(frames, unknowns, used * root, unit, apart, slope)
        if not upper < np.inf:
            return lower, np.inf
        changed = _radius_there(unknowns, root, used, unit, apart, slope, radius)
        if abs(changed - used) < RADIUS_TOLERANCE:
            return lower, max(upper, lower)
        used = changed
    # Every wider interval asks for a wider one still: the data do not bound the gap.
    return lower, np.inf


@compiled
def _radius_there(
    unknowns: Array, root: Array, used: float, unit: Array, apart: Array, slope: Array, radius: float
) -> float:
    """Radius for the place that an ellipsoid of the radius `used` touches."""
    spread = np.zeros((3, 3))
    for row in range(3):
        for column in range(3):
            for k in range(6):
                spread[row, column] += slope[row, k] * slope[column, k] / (used * used)
    normal = np.zeros(6)
    length = 0.0
    for column in range(6):
        for k in range(3):
            normal[column] += slope[k, column] * apart[k]
        length += normal[column] ** 2
    margins = np.zeros(2)
    slopes = np.zeros(2)
    for n in range(2):
        there, variance = unknowns[n, 2], 0.0
        for k in range(6):
            element = root[3 * n + 2, k]
            there += used * element * unit[k]
            variance += element * element
            slopes[n] += element * normal[k] / np.sqrt(max(length, 1e-300))
        margins[n] = there / np.sqrt(variance) - 1.0 / LARGEST_INVERSE_DEPTH_VARIATION
        slopes[n] /= np.sqrt(variance)
    return float(radius_at(apart, spread, margins, slopes, radius))
