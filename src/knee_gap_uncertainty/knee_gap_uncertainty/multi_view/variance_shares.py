"""Shares of the variance: the covariance of the points by all causes together, and each one's share.

The bearings' common part, one offset of each point for the whole track, is not estimated but considered: an
estimate that relied on the offset being the same everywhere would gain where the parallax is large, and be
wrong where it is not quite the same. The weights of the fit take all errors as independent; the covariance
does not.
"""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.likelihood import Linearised, Measured


@compiled
def considered_covariance(
    out: Linearised, common_share: float, inverse: Array, covariance: Array, slopes: Array
) -> float:
    """Write the covariance (6, 6) of the unknowns with a common part of the bearings' errors.

    With H the information, H'^-1 the `inverse` of the corrected one and h_i = J_i^T W_i K_i, where K_i K_i^T
    is the common part of the covariance of view i,

        C = H'^-1 (H + sum_i h_i sum_i h_i^T - sum_i h_i h_i^T) H'^-1.

    Writes also the `slopes` (6, 4) of the unknowns by the common offset, two parts of each point in their
    deviations: H'^-1 sum_i h_i. Returns the expected sum of squared weighted residuals, 4 N - 6
    where nothing is common.
    """
    total = np.zeros((6, 4))
    spread = np.zeros((6, 6))
    lever = np.zeros((6, 4))
    root = np.zeros((2, 2, 2))
    bearing_count = 0
    for i in range(out.residuals.shape[0]):
        for n in range(2):
            common_root(out.image_covariances, i, n, common_share, root)
            if out.weights[i, 2 * n, 2 * n] > 0.0:
                bearing_count += 1
        for row in range(6):
            n = row // 3
            for column in range(4):
                other = column // 2
                value = 0.0
                for axis in range(2):
                    through = (
                        out.weights[i, 2 * n + axis, 2 * other] * root[other, 0, column % 2]
                        + out.weights[i, 2 * n + axis, 2 * other + 1] * root[other, 1, column % 2]
                    )
                    value += out.jacobians[i, n, axis, row % 3] * through
                lever[row, column] = value
                total[row, column] += value
        for row in range(6):
            for column in range(6):
                for k in range(4):
                    spread[row, column] += lever[row, k] * lever[column, k]
    for row in range(6):
        for column in range(6):
            spread[row, column] = out.information[row, column] - spread[row, column]
            for k in range(4):
                spread[row, column] += total[row, k] * total[column, k]
    expected = 2.0 * bearing_count
    through = np.zeros((6, 6))
    for row in range(6):
        for column in range(6):
            for k in range(6):
                through[row, column] += inverse[row, k] * spread[k, column]
        expected -= through[row, row]
    for row in range(6):
        for column in range(6):
            covariance[row, column] = 0.0
            for k in range(6):
                covariance[row, column] += through[row, k] * inverse[k, column]
        for column in range(4):
            slopes[row, column] = 0.0
            for k in range(6):
                slopes[row, column] += inverse[row, k] * total[k, column]
    return float(max(expected, 0.0))


@compiled
def common_root(covariances: Array, i: int, n: int, common_share: float, root: Array) -> None:
    """Write into root[n] the symmetric root (2, 2) of the common part of a bearing's covariance."""
    xx, yy, xy = covariances[i, n, 0, 0], covariances[i, n, 1, 1], covariances[i, n, 0, 1]
    side = np.sqrt(max(xx * yy - xy * xy, 0.0))
    scale = np.sqrt(common_share / max(xx + yy + 2.0 * side, 1e-300))
    root[n, 0, 0] = scale * (xx + side)
    root[n, 1, 1] = scale * (yy + side)
    root[n, 0, 1] = root[n, 1, 0] = scale * xy


@compiled
def variance_shares(
    measured: Measured, out: Linearised, unknowns: Array, common_share: float, inverse: Array
) -> Array:
    """(4,) shares of image, lens position, lens rotation and common part in the gap's variance, of sum 1.

    The estimate is linear in the residuals, x = H^-1 sum_i J_i^T W_i r_i, so the gap's gradient taken through
    it is how far each error of each view moves the gap; every cause adds the variance of what it moves. NaN
    where a point lies at or beyond infinity.
    """
    shares = np.full(4, np.nan)
    if not (unknowns[0, 2] > 0.0 and unknowns[1, 2] > 0.0):
        return shares
    gradient = gap_gradient(measured.frames, unknowns)
    through = np.zeros(6)
    for row in range(6):
        for k in range(6):
            through[row] += inverse[row, k] * gradient[k]
    common = np.zeros((2, 2))
    root = np.zeros((2, 2, 2))
    slope = np.zeros(4)
    moved = np.zeros((2, 2))
    position = np.zeros(3)
    turn = np.zeros(3)
    shares[:] = 0.0
    for i in range(out.residuals.shape[0]):
        for row in range(4):
            slope[row] = 0.0
            for k in range(3):
                slope[row] += out.jacobians[i, row // 2, row % 2, k] * through[3 * (row // 2) + k]
        for row in range(4):
            moved[row // 2, row % 2] = 0.0
            for k in range(4):
                moved[row // 2, row % 2] += out.weights[i, row, k] * slope[k]
        position[:] = 0.0
        turn[:] = 0.0
        for n in range(2):
            common_root(out.image_covariances, i, n, common_share, root)
            for axis in range(2):
                own = 0.0
                for k in range(2):
                    own += out.image_covariances[i, n, axis, k] * moved[n, k]
                    common[n, axis] += root[n, axis, k] * moved[n, k]
                shares[0] += (1.0 - common_share) * moved[n, axis] * own
            for k in range(3):
                position[k] += unknowns[n, 2] * out.lens_jacobians[i, n, 0, k] * moved[n, 0]
                position[k] += unknowns[n, 2] * out.lens_jacobians[i, n, 1, k] * moved[n, 1]
                turn[k] += out.axes[i, n, 1, k] * moved[n, 0] - out.axes[i, n, 0, k] * moved[n, 1]
        for row in range(3):
            for k in range(3):
                shares[1] += position[row] * measured.lens_covariances[i, row, k] * position[k]
                shares[2] += turn[row] * measured.rotation_covariances[i, row, k] * turn[k]
    for n in range(2):
        shares[3] += common[n, 0] ** 2 + common[n, 1] ** 2
    total = shares[0] + shares[1] + shares[2] + shares[3]
    for k in range(4):
        shares[k] /= total
    return shares


@compiled
def gap_gradient(frames: Array, unknowns: Array) -> Array:
    """(6,) derivative of the gap [m] by a, b, rho of both points."""
    apart = np.zeros(3)
    directions = np.zeros((2, 3))
    for n in range(2):
        for k in range(3):
            directions[n, k] = (
                frames[n, 0, k] + unknowns[n, 0] * frames[n, 1, k] + unknowns[n, 1] * frames[n, 2, k]
            )
            apart[k] += (2 * n - 1) * directions[n, k] / unknowns[n, 2]
    gap = max(np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2), 1e-15)
    gradient = np.zeros(6)
    for n in range(2):
        rho = unknowns[n, 2]
        for k in range(3):
            along = (2 * n - 1) * apart[k] / gap / rho
            gradient[3 * n] += along * frames[n, 1, k]
            gradient[3 * n + 1] += along * frames[n, 2, k]
            gradient[3 * n + 2] -= along * directions[n, k] / rho
    return gradient
