"""The effect of a large common offset on the gap, beyond first order.

The offset that all bearings of a point share is carried from the optical axis to each bearing, so that far
off the axis it is another turn in every view. What the fit makes of it is then not proportional to it. The
fit is repeated with the offset added and taken away along four directions of the space of both points'
offsets; the second differences of the gap, less those that the interval knows of already because a gap is no
linear function of the unknowns either, are how far its ends move (Cornish and Fisher's expansion to the
second order; nodes and weights as in the unscented transform, Julier and Uhlmann, Proceedings of the IEEE 92,
2004).
"""

from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Mask
from knee_gap_uncertainty.multi_view.likelihood import LARGEST_TANGENT, Linearised, Measured, blank, linearise
from knee_gap_uncertainty.multi_view.variance_shares import common_root, gap_gradient

# Deviation of the common offset [rad] times the tangent of half the angle off the axis: how much of the
# offset turns with the bearing. Below it the ends move by less than a twentieth of a deviation.
SMALLEST_TURN = 0.008
# How far from the middle the fit is repeated, in deviations of the offset.
NODE = 1.7320508075688772
# Newton steps of a repeated fit, from where the slopes put it and with the curvature of the first fit: one is
# right to the second order.
STEPS = 1


class Bend(NamedTuple):
    """How far the ends of the gap's interval move [m]: `mean` + (z^2 - 1) `skew` at the normal deviate z.

    `widening` is the factor of the gap's deviation. `is_bounded` is false where an offset within NODE
    deviations puts a point out of reach: the data do not bound the gap then.
    """

    mean: float
    skew: float
    widening: float
    is_bounded: bool


STRAIGHT = Bend(0.0, 0.0, 1.0, True)


@compiled
def is_large(measured: Measured, used: Mask, out: Linearised, common_share: float) -> bool:
    """Whether the offset is too large, or too far off the axis, to be taken to first order only."""
    if common_share <= 0.0:
        return False
    for i in range(measured.lens.shape[0]):
        for n in range(2):
            if not used[i, n]:
                continue
            ahead = 0.0
            for k in range(3):
                ahead += measured.lens_axes[i, 2, k] * measured.bearings[i, n, k]
            tangent = np.sqrt(max(1.0 - ahead * ahead, 0.0)) / max(1.0 + ahead, 1e-9)
            variance = max(out.image_covariances[i, n, 0, 0], out.image_covariances[i, n, 1, 1])
            if np.sqrt(common_share * variance) * tangent > SMALLEST_TURN:
                return True
    return False


@compiled
def bend_of_gap(
    measured: Measured,
    used: Mask,
    out: Linearised,
    common_share: float,
    inverse: Array,
    slopes: Array,
    unknowns: Array,
    covariance: Array,
) -> Bend:
    """Bend of the gap over the common offset of the fit at `unknowns` (2, 3).

    `out` and `inverse`, the inverse of the corrected information, are the fit's; `slopes` (6, 4) the change
    of the unknowns by each part of the offset, in its deviations; `covariance` (6, 6) theirs by all errors.
    """
    if not (unknowns[0, 2] > 0.0 and unknowns[1, 2] > 0.0):
        return Bend(0.0, 0.0, 1.0, False)
    turned = Measured(
        measured.lens,
        measured.bearings.copy(),
        measured.bearing_covariances,
        measured.lens_covariances,
        measured.rotation_covariances,
        measured.lens_axes,
        measured.centre,
        measured.frames,
    )
    again = blank(measured.lens.shape[0])
    gradient = gap_gradient(measured.frames, unknowns)
    steepest = np.zeros(4)
    for k in range(4):
        for row in range(6):
            steepest[k] += slopes[row, k] * gradient[row]
    steepness = np.sqrt(np.sum(steepest**2))
    first_order = 0.0
    for row in range(6):
        for column in range(6):
            first_order += gradient[row] * covariance[row, column] * gradient[column]
    if not 0.0 < first_order < np.inf:
        return Bend(0.0, 0.0, 1.0, False)
    directions = _directions(steepest, steepness)
    mean, skew, variance = 0.0, 0.0, 0.0
    straight = np.zeros((2, 3))
    for k in range(4):
        bend = 0.0
        for sign in (-1.0, 1.0):
            offset = sign * NODE * directions[k]
            for row in range(6):
                straight[row // 3, row % 3] = unknowns[row // 3, row % 3]
                for column in range(4):
                    straight[row // 3, row % 3] += slopes[row, column] * offset[column]
            _turn_bearings(measured, out, offset, common_share, turned.bearings)
            place = straight.copy()
            if not (_is_seen(straight) and _fit_again(turned, used, inverse, place, again)):
                return Bend(0.0, 0.0, 1.0, False)
            bend += (gap_of(measured.frames, place) - gap_of(measured.frames, straight)) / NODE**2
        mean += 0.5 * bend
        variance += 0.5 * bend * bend
        if k == 0:
            skew = 0.5 * bend * min(steepness**2 / first_order, 1.0)
    widening = np.sqrt(1.0 + variance / first_order)
    if not abs(mean) + abs(skew) + widening < np.inf:
        return Bend(0.0, 0.0, 1.0, False)
    return Bend(mean, skew, widening, True)


@compiled
def _directions(steepest: Array, steepness: float) -> Array:
    """(4, 4) orthonormal rows, of which the first is the steepest: Householder's reflection of the axes."""
    directions = np.eye(4)
    if steepness <= 0.0:
        return directions
    mirror = steepest / steepness
    mirror[0] -= 1.0
    squared = np.sum(mirror**2)
    if squared > 1e-12:
        for row in range(4):
            for column in range(4):
                directions[row, column] -= 2.0 * mirror[row] * mirror[column] / squared
    return directions


@compiled
def gap_of(frames: Array, unknowns: Array) -> float:
    """Distance of the two points [m]; inverse depths must be above 0."""
    squared = 0.0
    for k in range(3):
        apart = 0.0
        for n in range(2):
            direction = frames[n, 0, k] + unknowns[n, 0] * frames[n, 1, k] + unknowns[n, 1] * frames[n, 2, k]
            apart += (2 * n - 1) * direction / unknowns[n, 2]
        squared += apart * apart
    return float(np.sqrt(squared))


@compiled
def _turn_bearings(
    measured: Measured, out: Linearised, offset: Array, common_share: float, turned: Array
) -> None:
    """Write all bearings turned by an offset (4,), two parts of each point in deviations."""
    root = np.zeros((2, 2, 2))
    tangent = np.zeros(3)
    for i in range(measured.lens.shape[0]):
        for n in range(2):
            common_root(out.image_covariances, i, n, common_share, root)
            axes, bearing = measured.lens_axes[i], measured.bearings[i, n]
            ahead = axes[2, 0] * bearing[0] + axes[2, 1] * bearing[1] + axes[2, 2] * bearing[2]
            tangent[:] = 0.0
            for axis in range(2):
                along = axes[axis, 0] * bearing[0] + axes[axis, 1] * bearing[1] + axes[axis, 2] * bearing[2]
                along /= max(1.0 + ahead, 1e-9)
                part = root[n, axis, 0] * offset[2 * n] + root[n, axis, 1] * offset[2 * n + 1]
                for k in range(3):
                    tangent[k] += part * (axes[axis, k] - along * (axes[2, k] + bearing[k]))
            angle = np.sqrt(tangent[0] ** 2 + tangent[1] ** 2 + tangent[2] ** 2)
            sine_over_angle = np.sin(angle) / angle if angle > 1e-9 else 1.0
            for k in range(3):
                turned[i, n, k] = np.cos(angle) * bearing[k] + sine_over_angle * tangent[k]


@compiled
def _fit_again(turned: Measured, used: Mask, inverse: Array, place: Array, again: Linearised) -> bool:
    """Move `place` (2, 3) to the unknowns that fit the turned bearings; False where they run off."""
    for _ in range(STEPS):
        linearise(turned, used, place, again)
        for row in range(6):
            for k in range(6):
                place[row // 3, row % 3] += inverse[row, k] * again.score[k]
        if not _is_seen(place):
            return False
    return True


@compiled
def _is_seen(place: Array) -> bool:
    """Whether unknowns (2, 3) are of points that a lens can see."""
    reach = max(abs(place[0, 0]) + abs(place[0, 1]), abs(place[1, 0]) + abs(place[1, 1]))
    return bool(min(place[0, 2], place[1, 2]) > 0.0 and reach < LARGEST_TANGENT)
