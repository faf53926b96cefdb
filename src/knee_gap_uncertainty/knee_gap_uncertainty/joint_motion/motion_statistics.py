"""Statistics of a track's residuals, compared with those of two points that stand still.

Four statistics, chi-square with 2 degrees of freedom, the last with 3, where nothing moved. `present`: how
far a bearing of the present view lies from where the earlier views put it; `first`: the same of the view that
carries A0; `shift`: score test for a point that jumped sideways after view k, at its greatest over k;
`creep`: score test for both points that move at a constant rate. An
offset common to all bearings in the axes of the image is estimated along: a calibration error is no motion.
From the second view on the rays are tested to meet, at a depth that an arthroscope can look at.
"""

from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.joint_motion.creep import DEVIATIONS, creep_statistic
from knee_gap_uncertainty.joint_motion.offset_equations import (
    Normal,
    Scratch,
    add,
    add_sideways,
    invert,
    start_from_prior,
)
from knee_gap_uncertainty.multi_view.likelihood import Linearised, Measured, blank, linearise, mean_frames
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.numerics.small_matrix import cholesky, invert_factored

# One bearing in 10^4 exceeds it by chance; the price of an alarm is one image without numbers.
LARGEST_PRESENT = 18.4
# Views on either side of a jump: fewer may be a few bad edges, which the fit gates out.
FEWEST_VIEWS_BESIDE_A_SHIFT = 3

# Inverse depth while the data do not determine it [1/m]: from 2.5 mm to infinity within two deviations.
EXPECTED_INVERSE_DEPTH = 100.0
# While the data do not determine the depth, weights allow for points as near as 8 mm. Nearer: fewer tracks
# end by chance in their first images, but one that begins with wrong edges is no longer distinguished from a
# right one.
NEAREST = 120.0
SMALLEST_INVERSE_DEPTH = 2.0
# Below so many views the fit gates nothing, and the present view may have pulled it far.
FEWEST_VIEWS_TO_TRUST_A_FIT = 8
PASSES_WITHOUT_TRUST = 5
# Squared residual of a view (4 degrees of freedom) beyond which its weight falls.
LARGEST_FULL_WEIGHT = 13.3
# Errors that are all larger than stated are a matter of scale, up to this ratio of variances.
LARGEST_SCALE = 4.0
FEWEST_VIEWS_TO_SCALE = 10


class MotionStatistics(NamedTuple):
    """The statistics [-], and after which view (0 is the first) the shift came, -1 where untested.

    `largest_rate` [m/s] along the baseline that the views leave possible, if the tracked body may creep.
    """

    present: float
    first: float
    shift: float
    shift_after: int
    creep: float = 0.0
    largest_rate: float = float("nan")


class Observations(NamedTuple):
    """The arrays of N views, as in likelihood.Measured; `times` (N,) [s] are 0 if they are not known."""

    lens: Array
    bearings: Array
    bearing_covariances: Array
    lens_covariances: Array
    rotation_covariances: Array
    lens_axes: Array
    times: Array


def observations(views: Views) -> Observations:
    """The arrays of the views."""
    return Observations(
        views.lens_positions,
        views.bearings,
        views.bearing_covariances,
        views.lens_covariances,
        views.rotation_covariances,
        views.lens_axes,
        np.zeros(len(views)) if views.times is None else views.times,
    )


def motion_statistics(
    observed: Observations, fitted: MultiViewFit | None, rates: tuple[float, float] = (0.0, 0.0)
) -> MotionStatistics:
    """Statistics of views, the last of which is the present one; all zero for a single view.

    `fitted`: a fit over most of them, None if there is none; `rates` [m/s]: RMS rate of the creep that
    is not a contradiction, and deviation per axis of the creep of a body of which nothing is known.
    """
    count = len(observed.lens)
    if count < 2:
        return MotionStatistics(0.0, 0.0, 0.0, -1, 0.0, DEVIATIONS * rates[1])
    trusted = fitted is not None and count >= FEWEST_VIEWS_TO_TRUST_A_FIT
    if fitted is not None and trusted and np.isfinite(fitted.unknowns).all():
        measured = Measured(*observed[:-1], fitted.centre, fitted.frames)
        deviations = np.sqrt(np.diag(fitted.unknowns_covariance)[[2, 5]])
        nearest = np.minimum(NEAREST, fitted.unknowns[:, 2] + 2.0 * deviations)
        return MotionStatistics(
            *statistics_of_arrays(measured, fitted.unknowns, nearest, 1, observed.times, rates)
        )
    centre = observed.lens[:-1].mean(axis=0)
    measured = Measured(*observed[:-1], centre, mean_frames(observed.bearings[:-1]))
    start = np.array([[0.0, 0.0, EXPECTED_INVERSE_DEPTH]] * 2)
    nearest = np.full(2, NEAREST)
    return MotionStatistics(
        *statistics_of_arrays(measured, start, nearest, PASSES_WITHOUT_TRUST, observed.times, rates)
    )


def warm_up() -> None:
    """Compile, or load from the cache, all that the test runs, so that the first image is not late."""
    lens = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [2e-3, 0.0, 0.0]])
    towards = np.array([[0.0, 0.0, 0.01], [0.004, 0.0, 0.01]]) - lens[:, None]
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    covariance = np.tile(np.eye(3) * 1e-9, (3, 1, 1))
    views = Views(lens, bearings, np.tile(np.eye(3) * 1e-4, (3, 2, 1, 1)), covariance, covariance)
    motion_statistics(observations(views), None)


@compiled
def _admit_near_points(measured: Measured, nearest: Array, unknowns: Array, lens_covariances: Array) -> None:
    """Write covariances of the lens that turn the bearings as much as if the points were at `nearest`.

    An error of the lens position turns a bearing in proportion to the inverse depth. Where chance made that
    small while it was not known, the error would be taken for none.
    """
    factor = 1.0
    for n in range(2):
        inverse_depth = max(abs(unknowns[n, 2]), SMALLEST_INVERSE_DEPTH)
        factor = max(factor, (nearest[n] / inverse_depth) ** 2)
        if abs(unknowns[n, 2]) < SMALLEST_INVERSE_DEPTH:
            unknowns[n, 2] = SMALLEST_INVERSE_DEPTH
    lens_covariances[:] = factor * measured.lens_covariances


@compiled
def statistics_of_arrays(
    measured: Measured, start: Array, nearest: Array, passes: int, times: Array, rates: tuple[float, float]
) -> tuple[float, float, float, int, float, float]:
    """MotionStatistics on plain arrays, by `passes` Gauss-Newton steps over the earlier views.

    `nearest` (2,): inverse depths [1/m] that the weights must allow for.
    """
    count = measured.lens.shape[0]
    last = count - 1
    used = np.ones((count, 2), dtype=np.bool_)
    unknowns = start.copy()
    out = blank(count)
    admitted = Measured(
        measured.lens,
        measured.bearings,
        measured.bearing_covariances,
        measured.lens_covariances.copy(),
        measured.rotation_covariances,
        measured.lens_axes,
        measured.centre,
        measured.frames,
    )
    normal = Normal(np.zeros((10, 10)), np.zeros(10))
    scratch = Scratch(np.zeros((4, 10)), np.zeros(4))
    covariance = np.zeros((10, 10))
    weights = np.ones(count)
    for turn in range(passes):
        _admit_near_points(measured, nearest, unknowns, admitted.lens_covariances)
        linearise(admitted, used, unknowns, out)
        if turn == passes - 1:
            break
        start_from_prior(out, unknowns, normal)
        for i in range(last):
            add(out, i, 1.0, scratch, normal)
        if not invert(normal, covariance):
            return 0.0, 0.0, 0.0, -1, 0.0, DEVIATIONS * rates[1]
        step = covariance @ normal.score
        for k in range(6):
            unknowns[k // 3, k % 3] += step[k]

    start_from_prior(out, unknowns, normal)
    cost = 0.0
    for i in range(last):
        squared = _squared(out, i)
        # A view far off counts as much as one at the limit does.
        if last >= FEWEST_VIEWS_TO_TRUST_A_FIT:
            weights[i] = np.sqrt(min(1.0, LARGEST_FULL_WEIGHT / max(squared, 1e-12)))
        cost += weights[i] * squared
        add(out, i, weights[i], scratch, normal)
    scale = 1.0
    if last >= FEWEST_VIEWS_TO_SCALE:
        scale = min(max(cost / (4.0 * last - 6.0), 1.0), LARGEST_SCALE)
    if not invert(normal, covariance):
        return 0.0, 0.0, 0.0, -1, 0.0, DEVIATIONS * rates[1]
    present = _prediction(out, last, normal, covariance) / scale
    if present > LARGEST_PRESENT or last < FEWEST_VIEWS_BESIDE_A_SHIFT:
        return present, 0.0, 0.0, -1, 0.0, DEVIATIONS * rates[1]

    add(out, last, 1.0, scratch, normal)
    cost += _squared(out, last)
    add(out, 0, -weights[0], scratch, normal)
    if not invert(normal, covariance):
        return present, 0.0, 0.0, -1, 0.0, DEVIATIONS * rates[1]
    first = _prediction(out, 0, normal, covariance) / scale
    add(out, 0, weights[0], scratch, normal)
    if not invert(normal, covariance):
        return present, first, 0.0, -1, 0.0, DEVIATIONS * rates[1]
    shift, after = _largest_shift(out, weights, normal, covariance, cost)
    baseline = measured.lens[last] - measured.lens[0]
    creep, rate = creep_statistic(out, times, baseline, unknowns, weights, normal, rates)
    return present, first, shift, after, creep / scale, rate


@compiled
def _squared(out: Linearised, i: int) -> float:
    """Squared weighted residual of a view."""
    value = 0.0
    for row in range(4):
        for column in range(4):
            value += out.residuals[i, row] * out.weights[i, row, column] * out.residuals[i, column]
    return value


@compiled
def _prediction(out: Linearised, i: int, normal: Normal, covariance: Array) -> float:
    """Larger squared deviation, of both bearings, from what the views in `normal`, without `i`, predict."""
    factor = np.zeros((4, 4))
    spread = np.zeros((4, 4))
    if not cholesky(out.weights[i], factor):
        return 0.0
    invert_factored(factor, spread)
    largest = 0.0
    slopes = np.zeros((2, 10))
    residual = np.zeros(2)
    for n in range(2):
        slopes[:, :] = 0.0
        for axis in range(2):
            for k in range(3):
                slopes[axis, 3 * n + k] = out.jacobians[i, n, axis, k]
            slopes[axis, 6 + 2 * n + axis] = 1.0
        reach = slopes @ covariance
        for axis in range(2):
            residual[axis] = out.residuals[i, 2 * n + axis]
            for k in range(10):
                residual[axis] -= reach[axis, k] * normal.score[k]
        variance = reach @ slopes.T + spread[2 * n : 2 * n + 2, 2 * n : 2 * n + 2]
        largest = max(largest, _form(variance, residual[0], residual[1]))
    return largest


@compiled
def _largest_shift(
    out: Linearised, weights: Array, normal: Normal, covariance: Array, cost: float
) -> tuple[float, int]:
    """Largest statistic of a sideways shift of a point after a view, over the scale of what it leaves."""
    count = out.residuals.shape[0]
    after = Normal(np.zeros((4, 10)), np.zeros(4))
    scratch = Scratch(np.zeros((4, 10)), np.zeros(4))
    step = covariance @ normal.score
    score, variance, reach = np.zeros(2), np.zeros((2, 2)), np.zeros(10)
    dof = max(4.0 * count - 8.0, 1.0)
    largest, where = 0.0, -1
    for i in range(count - 1, FEWEST_VIEWS_BESIDE_A_SHIFT - 1, -1):
        add_sideways(out, i, weights[i], scratch, after)
        if count - i < FEWEST_VIEWS_BESIDE_A_SHIFT:
            continue
        for n in range(2):
            known = True
            for axis in range(2):
                row = after.information[2 * n + axis]
                score[axis] = after.score[2 * n + axis]
                for k in range(10):
                    score[axis] -= row[k] * step[k]
                    reach[k] = 0.0
                    for column in range(10):
                        reach[k] += covariance[k, column] * row[column]
                for other in range(2):
                    variance[axis, other] = row[3 * n + other]
                    for k in range(10):
                        variance[axis, other] -= reach[k] * after.information[2 * n + other, k]
                # If the views cannot distinguish a shift from another depth, only rounding is left.
                known = known and variance[axis, axis] > 1e-6 * row[3 * n + axis]
            if not known:
                continue
            statistic = _form(variance, score[0], score[1])
            if count >= FEWEST_VIEWS_TO_SCALE:
                statistic /= max(1.0, (cost - statistic) / dof)
            if statistic > largest:
                largest, where = statistic, i - 1
    return largest, where


@compiled
def _form(matrix: Array, x: float, y: float) -> float:
    """Quadratic form of (x, y) with the inverse of a (2, 2) matrix; 0 where it is not positive definite."""
    det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    if not det > 0.0:
        return 0.0
    form: float = (matrix[1, 1] * x * x - 2.0 * matrix[0, 1] * x * y + matrix[0, 0] * y * y) / det
    return form
