"""Whether the two points stand still, as the analysis assumes: tested on the residuals of every image.

Three statistics, all of them chi-square with 2 degrees of freedom where nothing moved. `present`: how far a
bearing of the present view lies from where the earlier views put it; `first`: the same of the view that
carries A0; `shift`: score test for a point that jumped sideways after view k, at its greatest over k. An
offset common to all bearings in the axes of the image is estimated along: a calibration error is no motion.
From the second view on the rays are tested to meet, at a depth that an arthroscope can look at.
"""

from enum import Enum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.compiled import compiled
from knee_gap_uncertainty.likelihood import Linearised, Measured, blank, linearise, mean_frames
from knee_gap_uncertainty.multi_view import MultiViewFit
from knee_gap_uncertainty.small_matrix import cholesky, invert_factored
from knee_gap_uncertainty.views import Views

Array = npt.NDArray[np.float64]

# One bearing in 10^4 exceeds it by chance; the price of an alarm is one image without numbers.
LARGEST_PRESENT = 18.4
# So many more contradicting images than agreeing ones end the track; fewer while it is young.
FEWEST_CONTRADICTIONS = 5
# One bearing in 20,000 exceeds it by chance: it is tested at every image and the price is the track.
LARGEST_FIRST = 19.8
# Fewer than 1 track in 100 of 600 images exceeds it by chance, by simulation: see `joint_motion_table`.
LARGEST_SHIFT = 26.0
# Views on either side of a jump: fewer may be a few bad edges, which the fit gates out.
FEWEST_VIEWS_BESIDE_A_SHIFT = 3

# Inverse depth where the data do not tell it [1/m]: from 2.5 mm to infinity within two deviations.
EXPECTED_INVERSE_DEPTH = 100.0
INVERSE_DEPTH_DEVIATION = 150.0
# While the data do not tell the depth, weights allow for points as near as 8 mm. Nearer: fewer tracks end by
# chance in their first images, but one that begins with wrong edges is no longer told from a right one.
NEAREST = 120.0
SMALLEST_INVERSE_DEPTH = 2.0
# Below so many views the fit gates nothing, and the present view may have pulled it far.
FEWEST_VIEWS_TO_TRUST_A_FIT = 8
PASSES_WITHOUT_TRUST = 5
# Squared residual of a view (4 degrees of freedom) beyond which its weight falls.
LARGEST_FULL_WEIGHT = 13.3
# Errors that are all larger than they were said to be are a matter of scale, up to this ratio of variances.
LARGEST_SCALE = 4.0
FEWEST_VIEWS_TO_SCALE = 10


class Finding(Enum):
    """What the views say of the points."""

    STILL = "the points stand still"
    CONTRADICTION = "the present bearings contradict the track"
    MOVED = "a point moved against the reference"


class MotionStatistics(NamedTuple):
    """The three statistics [-], and after which view (0 is the first) the shift came, -1 where untested."""

    present: float
    first: float
    shift: float
    shift_after: int


class JointMotionTest:
    """The sequential test of one track.

    An image that contradicts is a doubt that it takes an agreeing one to clear: where an edge was wrong from
    the start, its path crosses the true one now and then.
    """

    def __init__(self) -> None:
        # Images found still.
        self.still_count = 0
        self._doubts = 0

    def judge(self, views: Views, fitted: MultiViewFit | None, passing: Views | None = None) -> Finding:
        """Finding at the last of `views`, all earlier ones having been found still.

        `fitted`: the fit over `views`, None where there is none; `passing`: a single view from just before
        the last that is not among them. A contradicting view must not be kept.
        """
        observed = observations(views)
        if passing is not None:
            between = observations(passing)
            observed = Observations(
                *(np.concatenate([a[:-1], b, a[-1:]]) for a, b in zip(observed, between, strict=True))
            )
        return self.decide(motion_statistics(observed, fitted))

    def decide(self, found: MotionStatistics) -> Finding:
        """Finding at the present view from its statistics."""
        if found.present > LARGEST_PRESENT:
            self._doubts += 1
            # A young track is no better founded than what contradicts it.
            enough = min(FEWEST_CONTRADICTIONS, self.still_count)
            return Finding.MOVED if self._doubts >= enough else Finding.CONTRADICTION
        if self._doubts > 1:
            self._doubts -= 1
            return Finding.CONTRADICTION
        self._doubts = 0
        moved = found.first > LARGEST_FIRST or found.shift > LARGEST_SHIFT
        if moved:
            return Finding.MOVED
        self.still_count += 1
        return Finding.STILL


class Observations(NamedTuple):
    """The arrays of N views, as in likelihood.Measured."""

    lens: Array
    bearings: Array
    bearing_covariances: Array
    lens_covariances: Array
    rotation_covariances: Array
    lens_axes: Array


def observations(views: Views) -> Observations:
    """The arrays of the views."""
    return Observations(
        views.lens_positions,
        views.bearings,
        views.bearing_covariances,
        views.lens_covariances,
        views.rotation_covariances,
        views.lens_axes,
    )


def motion_statistics(observed: Observations, fitted: MultiViewFit | None) -> MotionStatistics:
    """Statistics of views, the last of which is the present one; all zero for a single view.

    `fitted`: a fit over most of them, None where there is none.
    """
    count = len(observed.lens)
    if count < 2:
        return MotionStatistics(0.0, 0.0, 0.0, -1)
    trusted = fitted is not None and count >= FEWEST_VIEWS_TO_TRUST_A_FIT
    if fitted is not None and trusted and np.isfinite(fitted.unknowns).all():
        measured = Measured(*observed, fitted.centre, fitted.frames)
        deviations = np.sqrt(np.diag(fitted.unknowns_covariance)[[2, 5]])
        nearest = np.minimum(NEAREST, fitted.unknowns[:, 2] + 2.0 * deviations)
        return MotionStatistics(*statistics_of_arrays(measured, fitted.unknowns, nearest, 1))
    centre = observed.lens[:-1].mean(axis=0)
    measured = Measured(*observed, centre, mean_frames(observed.bearings[:-1]))
    start = np.array([[0.0, 0.0, EXPECTED_INVERSE_DEPTH]] * 2)
    return MotionStatistics(*statistics_of_arrays(measured, start, np.full(2, NEAREST), PASSES_WITHOUT_TRUST))


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


class Normal(NamedTuple):
    """Normal equations of both points' a, b, rho and the common offset of each: (10, 10) and (10,)."""

    information: Array
    score: Array


class Scratch(NamedTuple):
    """W A (4, 10) and W r (4,) of one view."""

    weighted: Array
    pull: Array


@compiled
def statistics_of_arrays(
    measured: Measured, start: Array, nearest: Array, passes: int
) -> tuple[float, float, float, int]:
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
        _prior(out, unknowns, normal)
        for i in range(last):
            _add(out, i, 1.0, scratch, normal)
        if not _invert(normal, covariance):
            return 0.0, 0.0, 0.0, -1
        step = covariance @ normal.score
        for k in range(6):
            unknowns[k // 3, k % 3] += step[k]

    _prior(out, unknowns, normal)
    cost = 0.0
    for i in range(last):
        squared = _squared(out, i)
        # A view far off counts as much as one at the limit does.
        if last >= FEWEST_VIEWS_TO_TRUST_A_FIT:
            weights[i] = np.sqrt(min(1.0, LARGEST_FULL_WEIGHT / max(squared, 1e-12)))
        cost += weights[i] * squared
        _add(out, i, weights[i], scratch, normal)
    scale = 1.0
    if last >= FEWEST_VIEWS_TO_SCALE:
        scale = min(max(cost / (4.0 * last - 6.0), 1.0), LARGEST_SCALE)
    if not _invert(normal, covariance):
        return 0.0, 0.0, 0.0, -1
    present = _prediction(out, last, normal, covariance) / scale
    if present > LARGEST_PRESENT or last < FEWEST_VIEWS_BESIDE_A_SHIFT:
        return present, 0.0, 0.0, -1

    _add(out, last, 1.0, scratch, normal)
    cost += _squared(out, last)
    _add(out, 0, -weights[0], scratch, normal)
    if not _invert(normal, covariance):
        return present, 0.0, 0.0, -1
    first = _prediction(out, 0, normal, covariance) / scale
    _add(out, 0, weights[0], scratch, normal)
    if not _invert(normal, covariance):
        return present, first, 0.0, -1
    shift, after = _largest_shift(out, weights, normal, covariance, cost)
    return present, first, shift, after


@compiled
def _prior(out: Linearised, unknowns: Array, normal: Normal) -> None:
    """Start the normal equations with what is known without a view.

    The offset may be as large as all of the error of a bearing.
    """
    normal.information[:, :] = 0.0
    normal.score[:] = 0.0
    count = out.residuals.shape[0]
    for n in range(2):
        strength = 1.0 / INVERSE_DEPTH_DEVIATION**2
        normal.information[3 * n + 2, 3 * n + 2] = strength
        normal.score[3 * n + 2] = strength * (EXPECTED_INVERSE_DEPTH - unknowns[n, 2])
        for k in range(2):
            # Only so that a single view has an inverse.
            normal.information[3 * n + k, 3 * n + k] = 1e-6
        s00, s01, s11 = 0.0, 0.0, 0.0
        for i in range(count):
            s00 += out.image_covariances[i, n, 0, 0] / count
            s01 += out.image_covariances[i, n, 0, 1] / count
            s11 += out.image_covariances[i, n, 1, 1] / count
        det = s00 * s11 - s01 * s01
        row = 6 + 2 * n
        normal.information[row, row] = s11 / det
        normal.information[row + 1, row + 1] = s00 / det
        normal.information[row, row + 1] = -s01 / det
        normal.information[row + 1, row] = -s01 / det


@compiled
def _weigh(out: Linearised, i: int, weight: float, scratch: Scratch) -> None:
    """Write W A and W r of a view, A (4, 10) being the derivative of its bearings by all ten unknowns."""
    weighted, pull = scratch.weighted, scratch.pull
    weighted[:, :] = 0.0
    pull[:] = 0.0
    for row in range(4):
        for column in range(4):
            w = weight * out.weights[i, row, column]
            pull[row] += w * out.residuals[i, column]
            weighted[row, 6 + column] = w
            n, axis = column // 2, column % 2
            for k in range(3):
                weighted[row, 3 * n + k] += w * out.jacobians[i, n, axis, k]


@compiled
def _add(out: Linearised, i: int, weight: float, scratch: Scratch, normal: Normal) -> None:
    """Add a view, `weight` times, to the normal equations."""
    _weigh(out, i, weight, scratch)
    for row in range(4):
        n, axis = row // 2, row % 2
        normal.score[6 + row] += scratch.pull[row]
        for column in range(10):
            normal.information[6 + row, column] += scratch.weighted[row, column]
        for k in range(3):
            slope = out.jacobians[i, n, axis, k]
            normal.score[3 * n + k] += slope * scratch.pull[row]
            for column in range(10):
                normal.information[3 * n + k, column] += slope * scratch.weighted[row, column]


@compiled
def _add_sideways(out: Linearised, i: int, weight: float, scratch: Scratch, shifted: Normal) -> None:
    """Add a view to the four rows (4, 10) of the normal equations that belong to both points' a and b."""
    _weigh(out, i, weight, scratch)
    for row in range(4):
        n, axis = row // 2, row % 2
        for k in range(2):
            slope = out.jacobians[i, n, axis, k]
            shifted.score[2 * n + k] += slope * scratch.pull[row]
            for column in range(10):
                shifted.information[2 * n + k, column] += slope * scratch.weighted[row, column]


@compiled
def _invert(normal: Normal, covariance: Array) -> bool:
    """Write the inverse of the information; false where it has none."""
    factor = np.zeros((10, 10))
    if not cholesky(normal.information, factor):
        return False
    invert_factored(factor, covariance)
    return True


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
        _add_sideways(out, i, weights[i], scratch, after)
        if count - i < FEWEST_VIEWS_BESIDE_A_SHIFT:
            continue
        for n in range(2):
            told = True
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
                # Where the views cannot tell a shift from another depth nothing is left but rounding.
                told = told and variance[axis, axis] > 1e-6 * row[3 * n + axis]
            if not told:
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
