"""Score test for points that move at a constant rate against the lens: a body that creeps on its scope.

A body that creeps makes the lens appear at A + c t in place of A, with one rate c (3,) [m/s]: the same as
both points creeping by c t. Where the speed of the scope varies over the track, and where it turns back, that
is no other depth of the points, and the residuals show it. Where the scope moves uniformly nothing of it
shows: then the largest rate that the views leave possible is large.

The errors of the lens positions stand in the slope by the inverse depth as well as in the residuals, and
would look like creep by the speed of a scope that moves uniformly: score and information are corrected for
them, as in `likelihood`.
"""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.joint_motion.offset_equations import Normal, Scratch, invert, weigh
from knee_gap_uncertainty.multi_view.likelihood import Linearised
from knee_gap_uncertainty.numerics.small_matrix import cholesky, solve_factored

# Of the information on a rate: in a direction of which nothing is known, rounding is left.
RIDGE = 1e-6
# Of the information on an inverse depth that is due to errors of the lens positions: beyond it the travel is
# too short to measure a rate.
LARGEST_CORRECTED_SHARE = 0.02
TINY = 1e-9  # [m/s]
# What is possible is that many deviations.
DEVIATIONS = 3.0


@compiled
def creep_statistic(
    out: Linearised,
    times: Array,
    baseline: Array,
    unknowns: Array,
    weights: Array,
    normal: Normal,
    rates: tuple[float, float],
) -> tuple[float, float]:
    """Statistic of a rate, and the largest rate along the baseline that the views leave possible [m/s].

    The statistic is the squared length of the rate in deviations of its estimate and of what is admitted,
    chi-square with 3 degrees of freedom. Admitted are a rate of the RMS length `rates[0]` [m/s], and errors
    of the bearings that grow over the track as creep does; `rates[1]` [m/s] is the deviation of a rate, per
    axis, before any view. `times` (N,) [s]; `normal`, with all views, is that of both points.
    """
    count = times.size
    span = times[count - 1] - times[0]
    length = np.sqrt(np.sum(baseline * baseline))
    if not (span > 0.0 and length > 0.0):
        return 0.0, DEVIATIONS * rates[1]
    corrected = Normal(normal.information.copy(), normal.score.copy())
    covariance = np.zeros((10, 10))
    ridge = RIDGE
    for row in (2, 5):
        for column in (2, 5):
            twice = out.information[row, column] - out.corrected[row, column]
            corrected.information[row, column] -= twice
            corrected.score[row] += twice * unknowns[column // 3, 2]
            if row == column:
                ridge = max(ridge, twice / normal.information[row, row])
    if ridge > LARGEST_CORRECTED_SHARE or not invert(corrected, covariance):
        return 0.0, DEVIATIONS * rates[1]
    score, information, cross = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 10))
    scratch = Scratch(np.zeros((4, 10)), np.zeros(4))
    slopes, weighted = np.zeros((4, 3)), np.zeros((4, 3))
    image_variance = 0.0
    for i in range(count):
        weigh(out, i, weights[i], scratch)
        for row in range(4):
            n, axis = row // 2, row % 2
            image_variance += out.image_covariances[i, n, axis, axis] / (4.0 * count)
            for k in range(3):
                slopes[row, k] = -unknowns[n, 2] * out.lens_jacobians[i, n, axis, k] * (times[i] - times[0])
        for row in range(4):
            for k in range(3):
                weighted[row, k] = 0.0
                for column in range(4):
                    weighted[row, k] += weights[i] * out.weights[i, row, column] * slopes[column, k]
        for k in range(3):
            for row in range(4):
                score[k] += slopes[row, k] * scratch.pull[row]
                for column in range(3):
                    information[k, column] += slopes[row, k] * weighted[row, column]
                for column in range(10):
                    cross[k, column] += slopes[row, k] * scratch.weighted[row, column]
    reach = cross @ covariance
    left = score - reach @ corrected.score
    known = information - reach @ cross.T
    # What is corrected is known only as well as so many squares of an error determine its variance.
    wrong = ridge * length / span * np.sqrt(2.0 / count)
    noise = known + ridge * information + wrong**2 * (information @ information)
    nearest = max(abs(unknowns[0, 2]), abs(unknowns[1, 2]), 1.0)
    admitted = rates[0] ** 2 / 3.0 + image_variance / (nearest * span) ** 2
    factor, solution, spread = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    if not cholesky(noise + admitted * (known @ known), factor):
        return 0.0, DEVIATIONS * rates[1]
    solve_factored(factor, left, solution)
    statistic = np.sum(left * solution)
    if not cholesky(noise, factor):
        return statistic, DEVIATIONS * rates[1]
    # left = known c + e with e of the covariance `noise`: the posterior of c along the baseline.
    solved = np.zeros((3, 3))
    for k in range(3):
        solve_factored(factor, known[:, k].copy(), solved[:, k])
    posterior = known @ solved
    for k in range(3):
        posterior[k, k] += 1.0 / max(rates[1], TINY) ** 2
    if not cholesky(posterior, factor):
        return statistic, DEVIATIONS * rates[1]
    along = baseline / length
    solve_factored(factor, solved.T @ left, solution)
    solve_factored(factor, along, spread)
    rate = abs(np.sum(solution * along)) + DEVIATIONS * np.sqrt(np.sum(spread * along))
    return statistic, rate
