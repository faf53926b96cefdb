"""Maximum-likelihood position of both points from all views of a track.

The model stands in `likelihood`; here bad bearings are gated out and the scale of the errors is checked
against the residuals.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Mask
from knee_gap_core.values.errors import BadInputError, BaselineTooShortError
from knee_gap_uncertainty.multi_view.common_offset import STRAIGHT, Bend, bend_of_gap, is_large
from knee_gap_uncertainty.multi_view.likelihood import (
    FLAT_PRIOR,
    Linearised,
    Measured,
    blank,
    is_depth_lost,
    maximise,
    mean_frames,
    start,
)
from knee_gap_uncertainty.multi_view.variance_shares import considered_covariance, variance_shares
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.numerics.small_matrix import cholesky

# Squared length of a bearing's residual, in standard deviations, that 5 in 1000 exceed by chance (chi-square
# with 2 degrees of freedom). A bad bearing just below it moves the gap little; the price of the good ones
# above it is 3 % of variance where no error is common, and is in the covariance.
GATE = 10.6
# With fewer views a bad bearing pulls the fit to itself, and neither it nor the scale of the errors can be
# found.
FEWEST_VIEWS_TO_GATE = 5
FEWEST_VIEWS_TO_SCALE = 10
LARGEST_GATED_SHARE = 0.25
GATE_ROUNDS = 8
WITH_THE_WORST = 0.6
MEDIAN_CHI_SQUARE_2 = 1.3863
# Between these deviations of chi-square from its expectation the scale goes from 1 to the ratio of the two:
# chance alone does not widen an interval, and the interval does not jump where evidence begins.
SCALE_RAMP = (1.5, 2.5)
# A share of exactly 1 would leave the bearings no error of their own: without other errors their covariance
# has no inverse, and what is left of their information is a difference of equal numbers. One per cent of the
# variance, a tenth of the deviation, is no small remainder: over a short travel it doubles the interval.
LARGEST_COMMON_SHARE = 1.0 - 1e-6
# An inverse depth [1/m] below which a point is as good as at infinity.
AT_INFINITY = 1e-6
# Where nearly all of the error is common, residuals do not show its scale, however small they should be.
SMALLEST_EXPECTED_SHARE = 0.25


class Fitted(NamedTuple):
    """A fit as plain arrays; names as in MultiViewFit, `unknowns` (2, 3) and `covariance` (6, 6) of them."""

    centre: Array
    frames: Array
    unknowns: Array
    covariance: Array
    used: Mask
    residuals: Array
    chi_square_ratio: float
    scale: float
    shares: Array
    bend: Bend


@dataclass(frozen=True)
class MultiViewFit:
    """Both points, with the covariance that every admitted error gives them.

    `points` (2, 3) [m] in the frame of the views and `gap` [m], their distance: NaN where a point lies at or
    beyond infinity. `covariance` (6, 6) [m^2] of both points. `unknowns` (2, 3) and `unknowns_covariance` (6,
    6): a [-], b [-] and inverse depth [1/m] of each point about `centre` (3,) [m] in `frames` (2, 3, 3), as
    in `likelihood`. `chi_square_ratio`: squared weighted residuals over their expectation [-], about 1 where
    the errors are as large as stated; `scale` >= 1: what the covariances were multiplied by because of
    it. `used` (N, 2) is false for gated bearings; `residuals` (N, 2): their squared length in standard
    deviations. `shares` (4,): image, lens position, lens rotation and common part of the variance of the gap;
    they sum to 1, and are NaN where there is not a gap. `bend`: how far a large common offset moves
    the ends of the gap's interval.
    """

    points: Array
    gap: float
    covariance: Array
    centre: Array
    frames: Array
    unknowns: Array
    unknowns_covariance: Array
    chi_square_ratio: float
    scale: float
    used: Mask
    residuals: Array
    shares: Array
    bend: Bend = STRAIGHT

    @property
    def view_count(self) -> int:
        """Views behind the fit."""
        return len(self.used)

    @property
    def inverse_depth_variation(self) -> float:
        """Larger relative standard deviation of the inverse depths [-]; infinite at or beyond infinity."""
        depths = self.unknowns[:, 2]
        if not np.all(depths > AT_INFINITY):
            return float("inf")
        variances = np.diag(self.unknowns_covariance)[[2, 5]]
        return float(np.max(np.sqrt(np.maximum(variances, 0.0)) / depths))

    @property
    def gap_deviation(self) -> float:
        """Standard deviation of the gap [m], to first order; NaN where the gap is."""
        along = (self.points[1] - self.points[0]) / self.gap
        gradient = np.concatenate([-along, along])
        return float(np.sqrt(gradient @ self.covariance @ gradient))


def fit(views: Views) -> MultiViewFit:
    """Fit both points to all views.

    Raises BadInputError for fewer than two views, and BaselineTooShortError where all lens positions are the
    same: then no depth is in the data. A short travel is not an error: the relative error of the inverse
    depth shows it.
    """
    if len(views) < 2:
        raise BadInputError(f"at least 2 views are needed to measure depth, not {len(views)}")
    if not np.max(np.ptp(views.lens_positions, axis=0)) > 0.0:
        raise BaselineTooShortError(f"all {len(views)} views have the same lens position: depth needs travel")
    fitted = fit_arrays(
        views.lens_positions,
        views.bearings,
        views.bearing_covariances,
        views.lens_covariances,
        views.rotation_covariances,
        views.lens_axes,
        views.common_share,
    )
    points = points_of(fitted.centre, fitted.frames, fitted.unknowns)
    jacobian = points_jacobian(fitted.frames, fitted.unknowns)
    return MultiViewFit(
        points=points,
        gap=float(np.linalg.norm(points[1] - points[0])),
        covariance=jacobian @ fitted.covariance @ jacobian.T,
        centre=fitted.centre,
        frames=fitted.frames,
        unknowns=fitted.unknowns,
        unknowns_covariance=fitted.covariance,
        chi_square_ratio=fitted.chi_square_ratio,
        scale=fitted.scale,
        used=fitted.used,
        residuals=fitted.residuals,
        shares=fitted.shares,
        bend=fitted.bend,
    )


def points_of(centre: Array, frames: Array, unknowns: Array) -> Array:
    """(2, 3) points [m] of the unknowns a, b, rho (2, 3); NaN for an inverse depth that is not above 0."""
    directions = frames[:, 0] + unknowns[:, :1] * frames[:, 1] + unknowns[:, 1:2] * frames[:, 2]
    inverse_depth = np.where(unknowns[:, 2:] > AT_INFINITY, unknowns[:, 2:], np.nan)
    return np.asarray(centre + directions / inverse_depth)


def points_jacobian(frames: Array, unknowns: Array) -> Array:
    """(6, 6) derivative of both points [m] by the unknowns a, b, rho (2, 3) of both."""
    jacobian = np.zeros((6, 6))
    for n in range(2):
        a, b, inverse_depth = unknowns[n]
        inverse_depth = inverse_depth if inverse_depth > AT_INFINITY else np.nan
        direction = frames[n, 0] + a * frames[n, 1] + b * frames[n, 2]
        block = np.column_stack([frames[n, 1], frames[n, 2], -direction / inverse_depth]) / inverse_depth
        jacobian[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = block
    return jacobian


def warm_up() -> None:
    """Compile, or load from the cache, all that a fit runs, so that the first image is not late."""
    lens = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [2e-3, 0.0, 0.0]])
    towards = np.array([[0.0, 0.0, 0.01], [0.004, 0.0, 0.01]]) - lens[:, None]
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    covariance = np.tile(np.eye(3) * 1e-6, (3, 1, 1))
    fit(Views(lens, bearings, np.tile(np.eye(3) * 1e-4, (3, 2, 1, 1)), covariance, covariance))


@compiled
def fit_arrays(
    lens: Array,
    bearings: Array,
    bearing_covariances: Array,
    lens_covariances: Array,
    rotation_covariances: Array,
    lens_axes: Array,
    common_share: float,
) -> Fitted:
    """`fit` on plain arrays that were checked before; `lens_axes` as in Measured."""
    count = lens.shape[0]
    share = min(common_share, LARGEST_COMMON_SHARE)
    centre = np.zeros(3)
    for i in range(count):
        for k in range(3):
            centre[k] += lens[i, k] / count
    measured = Measured(
        lens,
        bearings,
        bearing_covariances,
        lens_covariances,
        rotation_covariances,
        lens_axes,
        centre,
        mean_frames(bearings),
    )
    unknowns = np.zeros((2, 3))
    start(measured, unknowns)
    used = np.ones((count, 2), dtype=np.bool_)
    out = blank(count)
    inverse = np.zeros((6, 6))
    residuals = np.zeros((count, 2))
    cost = maximise(measured, used, unknowns, out, inverse)
    allowed = int(LARGEST_GATED_SHARE * 2 * count) if count >= FEWEST_VIEWS_TO_GATE else 0
    for _ in range(GATE_ROUNDS):
        squared_residuals(out, used, inverse, residuals)
        gated = _gate(residuals, used, allowed)
        if gated == 0:
            break
        allowed -= gated
        cost = maximise(measured, used, unknowns, out, inverse)
    covariance = np.zeros((6, 6))
    slopes = np.zeros((6, 4))
    expected = considered_covariance(out, share, inverse, covariance, slopes)
    bend = STRAIGHT
    if is_large(measured, used, out, share) and not is_depth_lost(unknowns, out):
        bend = bend_of_gap(measured, used, out, share, inverse, slopes, unknowns, covariance)
    if count >= FEWEST_VIEWS_TO_GATE:
        covariance *= price_of_gate(share)
    shares = variance_shares(measured, out, unknowns, share, inverse)
    dof = -6.0
    for i in range(count):
        dof += 2.0 * (used[i, 0] + used[i, 1])
    ratio = cost / max(expected, SMALLEST_EXPECTED_SHARE * dof) if dof > 0.0 else np.nan
    scale = 1.0
    if count >= FEWEST_VIEWS_TO_SCALE:
        ramp = ((ratio - 1.0) * np.sqrt(0.5 * dof) - SCALE_RAMP[0]) / (SCALE_RAMP[1] - SCALE_RAMP[0])
        scale += min(max(ramp, 0.0), 1.0) * (ratio - 1.0)
        covariance *= scale
    is_lost = is_depth_lost(unknowns, out) or not bend.is_bounded
    if is_lost or not cholesky(covariance, np.zeros((6, 6))):
        for row in range(6):
            for column in range(6):
                covariance[row, column] = 1.0 if row == column else 0.0
        for n in range(2):
            covariance[3 * n + 2, 3 * n + 2] = 1.0 / FLAT_PRIOR + (10.0 * unknowns[n, 2]) ** 2
    return Fitted(centre, measured.frames, unknowns, covariance, used, residuals, ratio, scale, shares, bend)


@compiled
def price_of_gate(common_share: float) -> float:
    """Factor of the variance where good bearings beyond the gate are given up: 1 / P(chi-square_4 < gate).

    Residuals are of the independent part, the gate is set by the whole.
    """
    half = 0.5 * GATE / (1.0 - common_share)
    return float(1.0 / (1.0 - np.exp(-half) * (1.0 + half)))


@compiled
def squared_residuals(out: Linearised, used: Mask, inverse: Array, residuals: Array) -> None:
    """Write every bearing's squared residual in its standard deviations, the fit's pull removed.

    For a weight W and a Jacobian J of a view, W r has the covariance W - W J H^-1 J^T W; its block of one
    bearing gives the statistic of a shift of that bearing alone. NaN for bearings that are not used.
    """
    product = np.zeros((4, 6))
    for i in range(used.shape[0]):
        for row in range(4):
            for n in range(2):
                for k in range(3):
                    product[row, 3 * n + k] = (
                        out.weights[i, row, 2 * n] * out.jacobians[i, n, 0, k]
                        + out.weights[i, row, 2 * n + 1] * out.jacobians[i, n, 1, k]
                    )
        for n in range(2):
            if not used[i, n]:
                residuals[i, n] = np.nan
                continue
            r0, r1 = 2 * n, 2 * n + 1
            score_0, score_1 = 0.0, 0.0
            for k in range(4):
                score_0 += out.weights[i, r0, k] * out.residuals[i, k]
                score_1 += out.weights[i, r1, k] * out.residuals[i, k]
            v00, v01, v11 = out.weights[i, r0, r0], out.weights[i, r0, r1], out.weights[i, r1, r1]
            # A bearing that the fit follows wholly has no residual to judge it by.
            floor = 1e-6 * (v00 + v11)
            for k in range(6):
                pulled_0, pulled_1 = 0.0, 0.0
                for column in range(6):
                    pulled_0 += product[r0, column] * inverse[column, k]
                    pulled_1 += product[r1, column] * inverse[column, k]
                v00 -= pulled_0 * product[r0, k]
                v01 -= pulled_0 * product[r1, k]
                v11 -= pulled_1 * product[r1, k]
            v00, v11 = v00 + floor, v11 + floor
            residuals[i, n] = (
                v11 * score_0 * score_0 - 2.0 * v01 * score_0 * score_1 + v00 * score_1 * score_1
            ) / (v00 * v11 - v01 * v01)


@compiled
def _gate(residuals: Array, used: Mask, allowed: int) -> int:
    """Take the worst bearings out of use, those next to the worst at once; return how many.

    The gate widens with the median of the residuals: errors that are all larger than stated are
    a matter of scale, not outliers.
    """
    if allowed == 0:
        return 0
    known = np.zeros(2 * residuals.shape[0])
    count = 0
    for i in range(residuals.shape[0]):
        for n in range(2):
            if used[i, n]:
                known[count] = residuals[i, n]
                count += 1
    known = np.sort(known[:count])
    gate = GATE * max(1.0, known[count // 2] / MEDIAN_CHI_SQUARE_2)
    worst = known[count - 1]
    if not worst > gate:
        return 0
    threshold = max(gate, WITH_THE_WORST * worst)
    found = 0
    for i in range(residuals.shape[0]):
        for n in range(2):
            if used[i, n] and residuals[i, n] >= threshold and found < allowed:
                used[i, n] = False
                found += 1
    return found
