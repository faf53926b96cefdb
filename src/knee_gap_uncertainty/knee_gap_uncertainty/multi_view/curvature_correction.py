"""Distance of an accepted estimate from a curved surface that holds the truth, compiled.

An interval of the distance between two points holds a value d0 while the estimate lies within a radius k, in
standard deviations, of the surface on which the distance is d0. For a plane the chance to be farther is that
of a normal deviate. Two things change it.

The surface of a constant distance is an ellipsoid there; where a standard deviation is of the size of the
distance itself it is strongly curved, and an estimate outside it is farther from it than from its tangent
plane.

Only estimates of enough parallax are accepted. A point whose depth is near the limit is accepted when its
error makes it seem nearer than it is, and of those the same radius holds far fewer; on the other side, the
estimates that would have missed are those refused. The chance that counts is the one among the accepted.
"""

from math import erfc, sqrt

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array

# Gauss-Hermite rule of order 10 for the absolute value of a standard normal deviate.
NODES = (0.4849357075154976, 1.465989094391158, 2.484325841638955, 3.581823483551927, 4.859462828332312)
NODE_WEIGHTS = (
    0.689284669864038,
    0.2709674059605356,
    0.03822316100154054,
    0.001516141868624434,
    8.621305261436625e-06,
)
# A surface less curved than this [standard deviations] is a plane to the accuracy of a published level.
FLAT = 20.0
LARGEST_RADIUS = 5.0
# Margin [standard deviations] from which on refusals are too rare to count.
SURE = 4.0
GRID_STEP = 0.1
GRID_COUNT = 129


@compiled
def radius_at(
    difference: Array, covariance: Array, margins: Array, slopes: Array, plane_radius: float
) -> float:
    """Radius [-] that an accepted estimate strays beyond with the two-sided chance of `plane_radius`.

    The surface holds all differences (3,) [m] of the length of `difference`, whose place on it is where the
    estimate is nearest; `covariance` (3, 3) [m^2] of the difference. Of each point, were it there: `margins`
    (2,) is how many standard deviations of its inverse depth it lies inside the limit of acceptance and
    `slopes` (2,) the correlation of that inverse depth with the distance.
    """
    product = np.zeros(3)
    gradient, steepness, squared = 0.0, 0.0, 0.0
    for row in range(3):
        for k in range(3):
            product[row] += covariance[row, k] * difference[k]
        gradient += difference[row] * product[row]
        steepness += product[row] * product[row]
        squared += difference[row] * difference[row]
    if not (gradient > 0.0 and squared > 0.0):
        return LARGEST_RADIUS
    # In the space where the estimate has unit variance the surface is y^T C y = d^2, with normal C y / G.
    trace = covariance[0, 0] + covariance[1, 1] + covariance[2, 2] - steepness / gradient
    determinant = _determinant(covariance) * squared / gradient
    spread = sqrt(max(0.25 * trace * trace - determinant, 0.0))
    flat_side = sqrt(gradient) / max(0.5 * trace - spread, 1e-300)
    curved_side = sqrt(gradient) / max(0.5 * trace + spread, 1e-300)
    chord = 2.0 * gradient * sqrt(gradient) / steepness
    all_accepted = min(margins[0], margins[1]) > SURE
    if all_accepted and curved_side > FLAT:
        return plane_radius
    above = accepted_above(margins, slopes)
    target = 2.0 * _tail(plane_radius) * above[0]
    low, high = 0.5 * plane_radius, LARGEST_RADIUS
    for _ in range(12):
        middle = 0.5 * (low + high)
        if stray_probability(middle, flat_side, curved_side, chord, above) > target:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@compiled
def accepted_above(margins: Array, slopes: Array) -> Array:
    """Chance, on a grid of deviations, that the estimate's distance is above it and the estimate is accepted.

    The grid has GRID_COUNT deviations, GRID_STEP apart, around 0.
    """
    above = np.zeros(GRID_COUNT)
    total = 0.0
    for i in range(GRID_COUNT - 1, -1, -1):
        deviation = (i - GRID_COUNT // 2) * GRID_STEP
        # The chance of the deviations that are nearer to this one than to the others.
        weight = _tail(deviation - 0.5 * GRID_STEP) - _tail(deviation + 0.5 * GRID_STEP)
        for n in range(2):
            left = sqrt(max(1.0 - slopes[n] * slopes[n], 1e-6))
            weight *= _tail(-(margins[n] + slopes[n] * deviation) / left)
        above[i] = total + 0.5 * weight
        total += weight
    return above


@compiled
def stray_probability(radius: float, first: float, second: float, chord: float, above: Array) -> float:
    """Chance that an estimate is farther than `radius` from a convex surface through the truth, and accepted.

    `first` and `second` are its radii of curvature there and `chord` how far the surface is on the other
    side, all in standard deviations. Along the surface the estimate strays normally and the surface falls
    away from it.
    """
    total = 0.0
    for i in range(5):
        for j in range(5):
            weight = NODE_WEIGHTS[i] * NODE_WEIGHTS[j]
            outside = _falls_away(first + radius, NODES[i]) + _falls_away(second + radius, NODES[j])
            if radius - outside <= -0.5 * chord:
                total += weight * above[0]
                continue
            total += weight * (_look_up(above, radius - outside))
            total += weight * (above[0] - _look_up(above, -(chord + radius - outside)))
            inside = _falls_away(first - radius, NODES[i]) + _falls_away(second - radius, NODES[j])
            between = _look_up(above, -(chord - radius - inside)) - _look_up(above, -(radius + inside))
            total += weight * max(between, 0.0)
    return total


@compiled
def _look_up(above: Array, deviation: float) -> float:
    """Value of a table on the grid of deviations, linear between."""
    place = deviation / GRID_STEP + GRID_COUNT // 2
    if not place > 0.0:
        return float(above[0])
    if place >= GRID_COUNT - 1:
        return 0.0
    i = int(place)
    return float(above[i] + (place - i) * (above[i + 1] - above[i]))


@compiled
def _falls_away(radius: float, along: float) -> float:
    """How far a circle falls away from its tangent at a distance along it; infinite beyond the circle."""
    if along >= radius:
        return np.inf
    return radius - sqrt(radius * radius - along * along)


@compiled
def _tail(deviation: float) -> float:
    """Chance of a standard normal deviate to be larger."""
    return 0.5 * erfc(deviation * 0.7071067811865476)


@compiled
def _determinant(m: Array) -> float:
    """Determinant of a (3, 3) matrix."""
    return float(
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )
