"""Likelihood of all bearings of a track, compiled: its curvature, and its maximum over the two points.

Model. Point n lies at G_n = c + m_n / rho_n with m_n = u_n + a_n p_n + b_n q_n: c the mean lens position, u_n
the mean bearing, (p_n, q_n) completing the frame. Inverse depth rho keeps the likelihood near Gaussian where
the parallax is small. A measured bearing deviates from the predicted direction, in the image axes there, by

    r = J_c dc + J_w w + e,    e ~ N(0, S)

with S the bearing's covariance; dc and w, the errors of the lens position and rotation, are shared by the two
bearings of a view and integrated out. The image axes are the lens's x and y, carried from its optical axis to
the predicted direction by the smallest rotation. Taken at the measured direction, the residuals of many views
would bias the depth.

The slope of a residual by rho contains the lens position, so its error appears twice in the score J^T W r and
drives rho to 0. Its mean is known and taken out of score and information (corrected score: Nakamura,
Biometrika 77, 1990): with Q_nm = sum over axes of W_nm (J_c dC J_c^T)_nm / (rho_n rho_m), the score of rho
gains Q rho, the information loses Q.
"""

from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Mask
from knee_gap_uncertainty.numerics.small_matrix import cholesky, invert_factored, solve_factored

# Information of a prior on inverse depth with a deviation of 1e6 / m: a track without parallax then has a
# curvature.
FLAT_PRIOR = 1e-12
LARGEST_PASS_COUNT = 12
LARGEST_RISE = 1.5
# Tangent of the angle from the mean bearing beyond which no point can be that all views saw.
LARGEST_TANGENT = 100.0
# Share of the information on an inverse depth that may be due to the errors of the lens positions.
LARGEST_CORRECTION = 0.5
# Squared length of the last step, in standard deviations of the estimate; what is left after it is far less.
CONVERGED = 1e-4


class Measured(NamedTuple):
    """The arrays of Views, and the frame of the unknowns: centre (3,), rows u, p, q of each point (2, 3, 3).

    `lens_axes` (N, 3, 3): rows x, y and optical axis z of the lens in each view.
    """

    lens: Array
    bearings: Array
    bearing_covariances: Array
    lens_covariances: Array
    rotation_covariances: Array
    lens_axes: Array
    centre: Array
    frames: Array


class Linearised(NamedTuple):
    """What a pass over the views writes; a bearing's two image axes stand before the three columns.

    `residuals` (N, 4); `jacobians` (N, 2, 2, 3) by a, b, rho; `lens_jacobians` (N, 2, 2, 3), over rho; `axes`
    (N, 2, 2, 3) of the image; `image_covariances` (N, 2, 2, 2); `weights` (N, 4, 4): inverse covariance of
    both bearings of a view; `information` (6, 6), as it is and `corrected`; `score` (6,), corrected.
    """

    residuals: Array
    jacobians: Array
    lens_jacobians: Array
    axes: Array
    image_covariances: Array
    weights: Array
    information: Array
    corrected: Array
    score: Array


@compiled
def blank(count: int) -> Linearised:
    """Zeros for `count` views."""
    return Linearised(
        np.zeros((count, 4)),
        np.zeros((count, 2, 2, 3)),
        np.zeros((count, 2, 2, 3)),
        np.zeros((count, 2, 2, 3)),
        np.zeros((count, 2, 2, 2)),
        np.zeros((count, 4, 4)),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        np.zeros(6),
    )


@compiled
def mean_frames(bearings: Array) -> Array:
    """(2, 3, 3): for each point the rows u (mean bearing), p, q, right-handed."""
    frames = np.zeros((2, 3, 3))
    mean = np.zeros(3)
    for n in range(2):
        mean[:] = 0.0
        for i in range(bearings.shape[0]):
            for k in range(3):
                mean[k] += bearings[i, n, k]
        length = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
        for k in range(3):
            frames[n, 0, k] = mean[k] / length if length > 1e-9 else bearings[0, n, k]
        complete_frame(frames[n])
    return frames


@compiled
def complete_frame(frame: Array) -> None:
    """Write rows 1 and 2 of a right-handed frame (3, 3) whose row 0 is a unit vector."""
    least = 0
    for k in range(1, 3):
        if abs(frame[0, k]) < abs(frame[0, least]):
            least = k
    norm = np.sqrt(1.0 - frame[0, least] ** 2)
    for k in range(3):
        frame[1, k] = ((1.0 if k == least else 0.0) - frame[0, least] * frame[0, k]) / norm
    for k in range(3):
        ahead, behind = (k + 1) % 3, (k + 2) % 3
        frame[2, k] = frame[0, ahead] * frame[1, behind] - frame[0, behind] * frame[1, ahead]


@compiled
def start(measured: Measured, unknowns: Array) -> None:
    """Write first unknowns, over zeros: linear least squares of the distances of the rays over the depth."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    factor = np.zeros((3, 3))
    columns = np.zeros((4, 3))
    across = np.zeros((4, 3))
    for n in range(2):
        normal[:, :] = 0.0
        right[:] = 0.0
        for i in range(measured.lens.shape[0]):
            for k in range(3):
                columns[0, k] = measured.frames[n, 1, k]
                columns[1, k] = measured.frames[n, 2, k]
                columns[2, k] = measured.centre[k] - measured.lens[i, k]
                columns[3, k] = measured.frames[n, 0, k]
            for row in range(4):
                along = 0.0
                for k in range(3):
                    along += columns[row, k] * measured.bearings[i, n, k]
                for k in range(3):
                    across[row, k] = columns[row, k] - along * measured.bearings[i, n, k]
            for row in range(3):
                for k in range(3):
                    right[row] -= across[row, k] * across[3, k]
                    for column in range(3):
                        normal[row, column] += across[row, k] * across[column, k]
        normal[2, 2] += 1e-9 * normal[2, 2] + 1e-15
        if cholesky(normal, factor):
            solve_factored(factor, right, unknowns[n])


@compiled
def linearise(measured: Measured, used: Mask, unknowns: Array, out: Linearised) -> float:
    """Fill `out` at the unknowns; return the sum of the squared weighted residuals."""
    shared = np.zeros((4, 4))
    covariance = np.zeros((4, 4))
    twice = np.zeros((2, 2))
    out.information[:, :] = 0.0
    out.score[:] = 0.0
    cost = 0.0
    for i in range(measured.lens.shape[0]):
        for n in range(2):
            _predict(measured, i, n, unknowns, out)
        _pair_covariance(measured, i, unknowns, out, shared, covariance)
        _invert_pair(covariance, i, used, out.weights)
        cost += _add_view(i, out)
        for row in range(4):
            for column in range(4):
                twice[row // 2, column // 2] += out.weights[i, row, column] * shared[row, column]
    strength = 1.0
    for n in range(2):
        out.information[3 * n + 2, 3 * n + 2] += FLAT_PRIOR
        if twice[n, n] > 0.0:
            strength = min(strength, LARGEST_CORRECTION * out.information[3 * n + 2, 3 * n + 2] / twice[n, n])
    for row in range(6):
        for column in range(6):
            out.corrected[row, column] = out.information[row, column]
    for n in range(2):
        for other in range(2):
            out.score[3 * n + 2] += strength * twice[n, other] * unknowns[other, 2]
            out.corrected[3 * n + 2, 3 * other + 2] -= strength * twice[n, other]
    return cost


@compiled
def is_depth_lost(unknowns: Array, out: Linearised) -> bool:
    """Whether no depth is in the data.

    The travel is of the size of the errors of the lens positions: the correction of the information for those
    was held at its limit, or has left none. Or the bearings contradict each other so far that the fit ran
    off.
    """
    for n in range(2):
        if not abs(unknowns[n, 0]) + abs(unknowns[n, 1]) < LARGEST_TANGENT:
            return True
    for k in (2, 5):
        if out.corrected[k, k] <= (1.0 - LARGEST_CORRECTION) * out.information[k, k] * (1.0 + 1e-9):
            return True
    return not cholesky(out.corrected, np.zeros((6, 6)))


@compiled
def maximise(measured: Measured, used: Mask, unknowns: Array, out: Linearised, covariance: Array) -> float:
    """Gauss-Newton from `unknowns`, which it overwrites; a step that makes the fit far worse is halved.

    Writes the inverse of the corrected information (6, 6), zero if there is none, and returns the sum of
    the squared weighted residuals.
    """
    factor = np.zeros((6, 6))
    step = np.zeros(6)
    trial = unknowns.copy()
    best_cost = np.inf
    length = np.inf
    for turn in range(LARGEST_PASS_COUNT):
        last = turn == LARGEST_PASS_COUNT - 1
        cost = linearise(measured, used, trial, out)
        if not cost <= LARGEST_RISE * best_cost + 10.0 and not last:
            for k in range(6):
                step[k] *= 0.5
                trial[k // 3, k % 3] = unknowns[k // 3, k % 3] + step[k]
            continue
        best_cost = cost
        for k in range(6):
            unknowns[k // 3, k % 3] = trial[k // 3, k % 3]
        if not cholesky(out.corrected, factor) and not cholesky(out.information, factor):
            covariance[:, :] = 0.0
            return float(best_cost)
        if length < CONVERGED or last:
            break
        solve_factored(factor, out.score, step)
        length = 0.0
        for k in range(6):
            length += step[k] * out.score[k]
            trial[k // 3, k % 3] = unknowns[k // 3, k % 3] + step[k]
    invert_factored(factor, covariance)
    return best_cost


@compiled
def _predict(measured: Measured, i: int, n: int, unknowns: Array, out: Linearised) -> None:
    """Write image axes, residual and Jacobians of one bearing."""
    frames, lens_axes = measured.frames, measured.lens_axes
    rho = unknowns[n, 2]
    cx = measured.centre[0] - measured.lens[i, 0]
    cy = measured.centre[1] - measured.lens[i, 1]
    cz = measured.centre[2] - measured.lens[i, 2]
    x = frames[n, 0, 0] + unknowns[n, 0] * frames[n, 1, 0] + unknowns[n, 1] * frames[n, 2, 0] + rho * cx
    y = frames[n, 0, 1] + unknowns[n, 0] * frames[n, 1, 1] + unknowns[n, 1] * frames[n, 2, 1] + rho * cy
    z = frames[n, 0, 2] + unknowns[n, 0] * frames[n, 1, 2] + unknowns[n, 1] * frames[n, 2, 2] + rho * cz
    inverse = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x * inverse, y * inverse, z * inverse
    ahead = lens_axes[i, 2, 0] * x + lens_axes[i, 2, 1] * y + lens_axes[i, 2, 2] * z
    bx, by, bz = measured.bearings[i, n, 0], measured.bearings[i, n, 1], measured.bearings[i, n, 2]
    cosine = x * bx + y * by + z * bz
    sine = np.sqrt((y * bz - z * by) ** 2 + (z * bx - x * bz) ** 2 + (x * by - y * bx) ** 2)
    angle_over_sine = np.arctan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    for axis in range(2):
        along = lens_axes[i, axis, 0] * x + lens_axes[i, axis, 1] * y + lens_axes[i, axis, 2] * z
        along /= max(1.0 + ahead, 1e-9)
        ex = lens_axes[i, axis, 0] - along * (lens_axes[i, 2, 0] + x)
        ey = lens_axes[i, axis, 1] - along * (lens_axes[i, 2, 1] + y)
        ez = lens_axes[i, axis, 2] - along * (lens_axes[i, 2, 2] + z)
        out.axes[i, n, axis, 0], out.axes[i, n, axis, 1], out.axes[i, n, axis, 2] = ex, ey, ez
        for k in range(2):
            slope = ex * frames[n, 1 + k, 0] + ey * frames[n, 1 + k, 1] + ez * frames[n, 1 + k, 2]
            out.jacobians[i, n, axis, k] = inverse * slope
        out.jacobians[i, n, axis, 2] = inverse * (ex * cx + ey * cy + ez * cz)
        out.lens_jacobians[i, n, axis, 0] = -inverse * ex
        out.lens_jacobians[i, n, axis, 1] = -inverse * ey
        out.lens_jacobians[i, n, axis, 2] = -inverse * ez
        out.residuals[i, 2 * n + axis] = (ex * bx + ey * by + ez * bz) * angle_over_sine


@compiled
def _form(
    left: Array, row: tuple[int, int, int], middle: Array, i: int, column: tuple[int, int, int]
) -> float:
    """Bilinear form of two vectors left[i, n, axis, :], sign apart, and a matrix middle[i]."""
    value = 0.0
    for k in range(3):
        value += left[i, row[0], row[1], k] * (
            middle[i, k, 0] * left[i, column[0], column[1], 0]
            + middle[i, k, 1] * left[i, column[0], column[1], 1]
            + middle[i, k, 2] * left[i, column[0], column[1], 2]
        )
    return value


@compiled
def _pair_covariance(
    measured: Measured, i: int, unknowns: Array, out: Linearised, shared: Array, pair: Array
) -> None:
    """Write the covariance (4, 4) of both residuals of a view: own image errors and shared lens errors.

    `shared` (4, 4) is the part of the lens position, over both inverse depths. A rotation w moves a bearing
    along the first image axis by w . e_1 and along the second by -w . e_0.
    """
    for n in range(2):
        for row in range(2):
            for column in range(row + 1):
                value = 0.0
                for k in range(3):
                    value += out.axes[i, n, row, k] * (
                        measured.bearing_covariances[i, n, k, 0] * out.axes[i, n, column, 0]
                        + measured.bearing_covariances[i, n, k, 1] * out.axes[i, n, column, 1]
                        + measured.bearing_covariances[i, n, k, 2] * out.axes[i, n, column, 2]
                    )
                out.image_covariances[i, n, row, column] = value
                out.image_covariances[i, n, column, row] = value
    for row in range(4):
        n, axis = row // 2, row % 2
        for column in range(row + 1):
            other_n, other = column // 2, column % 2
            value = _form(out.lens_jacobians, (n, axis, 0), measured.lens_covariances, i, (other_n, other, 0))
            turned = _form(
                out.axes, (n, 1 - axis, 0), measured.rotation_covariances, i, (other_n, 1 - other, 0)
            )
            shared[row, column] = value
            shared[column, row] = value
            value *= unknowns[n, 2] * unknowns[other_n, 2]
            value += turned if axis == other else -turned
            if n == other_n:
                value += out.image_covariances[i, n, axis, other]
            pair[row, column] = value
            pair[column, row] = value


@compiled
def _invert_pair(s: Array, i: int, used: Mask, weights: Array) -> None:
    """Write the inverse of a (4, 4) covariance by its (2, 2) blocks; zero for a bearing that is not used."""
    if not (used[i, 0] and used[i, 1]):
        for row in range(4):
            for column in range(4):
                weights[i, row, column] = 0.0
        for n in range(2):
            if used[i, n]:
                k = 2 * n
                det = s[k, k] * s[k + 1, k + 1] - s[k, k + 1] * s[k, k + 1]
                weights[i, k, k], weights[i, k + 1, k + 1] = s[k + 1, k + 1] / det, s[k, k] / det
                weights[i, k, k + 1] = weights[i, k + 1, k] = -s[k, k + 1] / det
        return
    det = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
    i00, i01, i11 = s[1, 1] / det, -s[0, 1] / det, s[0, 0] / det
    # t = S00^-1 S01, and the inverse of the Schur complement of S00.
    t00, t01 = i00 * s[0, 2] + i01 * s[1, 2], i00 * s[0, 3] + i01 * s[1, 3]
    t10, t11 = i01 * s[0, 2] + i11 * s[1, 2], i01 * s[0, 3] + i11 * s[1, 3]
    c00 = s[2, 2] - s[0, 2] * t00 - s[1, 2] * t10
    c01 = s[2, 3] - s[0, 2] * t01 - s[1, 2] * t11
    c11 = s[3, 3] - s[0, 3] * t01 - s[1, 3] * t11
    det = c00 * c11 - c01 * c01
    w00, w01, w11 = c11 / det, -c01 / det, c00 / det
    u00, u01 = t00 * w00 + t01 * w01, t00 * w01 + t01 * w11
    u10, u11 = t10 * w00 + t11 * w01, t10 * w01 + t11 * w11
    weights[i, 2, 2], weights[i, 3, 3] = w00, w11
    weights[i, 2, 3] = weights[i, 3, 2] = w01
    weights[i, 0, 2] = weights[i, 2, 0] = -u00
    weights[i, 0, 3] = weights[i, 3, 0] = -u01
    weights[i, 1, 2] = weights[i, 2, 1] = -u10
    weights[i, 1, 3] = weights[i, 3, 1] = -u11
    weights[i, 0, 0] = i00 + u00 * t00 + u01 * t01
    weights[i, 1, 1] = i11 + u10 * t10 + u11 * t11
    weights[i, 0, 1] = weights[i, 1, 0] = i01 + u00 * t10 + u01 * t11


@compiled
def _add_view(i: int, out: Linearised) -> float:
    """Add J^T W J and J^T W r of one view; return r^T W r."""
    cost = 0.0
    for row in range(4):
        n, axis = row // 2, row % 2
        pull = 0.0
        for column in range(4):
            pull += out.weights[i, row, column] * out.residuals[i, column]
        cost += out.residuals[i, row] * pull
        for k in range(3):
            out.score[3 * n + k] += out.jacobians[i, n, axis, k] * pull
        for other in range(2):
            w0, w1 = out.weights[i, row, 2 * other], out.weights[i, row, 2 * other + 1]
            for column in range(3):
                weighted = w0 * out.jacobians[i, other, 0, column] + w1 * out.jacobians[i, other, 1, column]
                for k in range(3):
                    out.information[3 * n + k, 3 * other + column] += out.jacobians[i, n, axis, k] * weighted
    return cost
