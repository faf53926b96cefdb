"""The loops over all views of a track with the error that they share, compiled: they run at every image.

Parts of the error are a shift of the lens [m], a turn of it [rad], the clock [s] and those of the camera [-],
(7 + k,). Their deviations have the root (7 + k, 7 + k) of `CalibrationError.root`, which is that of shift and
turn in its first six rows, the clock's deviation, and 1 for each error of the camera.
"""

from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Mask
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.numerics.small_matrix import cholesky, solve_factored
from knee_gap_uncertainty.numerics.vectors import Vector, cross, dot, norm, row, scale, subtract, unit, vector

PASSES = 3  # of Gauss and Newton: a degree of turn is not small beside a tenth of it
EXPECTED_DEPTH, DEPTH_SIGMA = 0.012, 0.02  # [m] of points, while the views do not determine it
# Of the noise of a bearing: what a calibration does below that is not worth a fit.
NEGLIGIBLE = 0.2


class SharedViews(NamedTuple):
    """What the loops need of N views.

    `lens` (N, 3) [m], `bearings` (N, 2, 3), `rotations` (N, 3, 3) of the calibrated lens, `motions` (N, 6),
    `camera_errors` (N, 2, 3, k); `image_variances` (N, 2), `lens_variances` (N,) and `rotation_variances`
    (N,) are those of an axis. Shifts are measured from `rotation` (3, 3), `motion` (6,) of one view, at which
    they are none: what moves all lenses alike moves the points with them.
    """

    lens: Array
    bearings: Array
    rotations: Array
    motions: Array
    camera_errors: Array
    image_variances: Array
    lens_variances: Array
    rotation_variances: Array
    rotation: Array
    motion: Array


def shared_views(views: Views, rotation: Array | None = None, motion: Array | None = None) -> SharedViews:
    """What the loops need of views; shifts are measured from the last, unless from another one."""
    rotations = np.ascontiguousarray(views.calibrated_rotations)
    motions = np.zeros((len(views), 6)) if views.lens_motions is None else views.lens_motions
    camera = np.zeros((len(views), 2, 3, 0)) if views.camera_errors is None else views.camera_errors
    return SharedViews(
        views.lens_positions,
        views.bearings,
        rotations,
        np.ascontiguousarray(motions),
        np.ascontiguousarray(camera),
        variances_of(views.bearing_covariances.reshape(-1, 3, 3), 2).reshape(-1, 2),
        variances_of(views.lens_covariances, 3),
        variances_of(views.rotation_covariances, 3),
        rotations[-1] if rotation is None else rotation,
        motions[-1] if motion is None else motion,
    )


@compiled
def variances_of(matrices: Array, axes: int) -> Array:
    """(N,) variance of an axis of covariances (N, 3, 3) that have so many axes with an error."""
    variances = np.empty(matrices.shape[0])
    for i in range(matrices.shape[0]):
        variances[i] = (matrices[i, 0, 0] + matrices[i, 1, 1] + matrices[i, 2, 2]) / axes
    return variances


@compiled
def rotation_matrix(turn: Vector) -> tuple[Vector, Vector, Vector]:
    """Rows of the rotation by a rotation vector [rad]."""
    angle = norm(turn)
    if angle > 1e-4:
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    else:
        first, second = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    x, y, z = turn
    diagonal = 1.0 - second * dot(turn, turn)
    return (
        (diagonal + second * x * x, second * x * y - first * z, second * x * z + first * y),
        (second * x * y + first * z, diagonal + second * y * y, second * y * z - first * x),
        (second * x * z - first * y, second * y * z + first * x, diagonal + second * z * z),
    )


@compiled
def take_error(views: SharedViews, parts: Array, lens: Array, bearings: Array, backs: Array) -> None:
    """Write the lens positions (N, 3) and bearings (N, 2, 3) of views as they would be without an error.

    `backs` (N, 3, 3) are the rotations that take the error's from those of the lens.
    """
    turn = np.zeros(3)
    for i in range(views.lens.shape[0]):
        for k in range(3):
            lens[i, k] = views.lens[i, k] - parts[6] * (views.motions[i, k] - views.motion[k])
            turn[k] = -parts[6] * views.motions[i, 3 + k]
            for j in range(3):
                lens[i, k] -= (views.rotations[i, k, j] - views.rotation[k, j]) * parts[j]
                turn[k] -= views.rotations[i, k, j] * parts[3 + j]
        back = rotation_matrix(vector(turn))
        for k in range(3):
            backs[i, k, 0], backs[i, k, 1], backs[i, k, 2] = back[k]
        for n in range(2):
            b = row(views.bearings[i], n)
            for k in range(parts.size - 7):
                off = views.camera_errors[i, n]
                b = subtract(b, scale(parts[7 + k], (off[0, k], off[1, k], off[2, k])))
            b = unit((dot(back[0], b), dot(back[1], b), dot(back[2], b)))
            bearings[i, n, 0], bearings[i, n, 1], bearings[i, n, 2] = b


@compiled
def explain(views: SharedViews, root: Array) -> tuple[Array, bool]:
    """The most likely parts of the error, and whether they matter: `calibration_fit.explained_by`."""
    size = root.shape[0]
    parts = np.zeros(size)
    start = np.empty((2, 3))
    for n in range(2):
        for k in range(3):
            start[n, k] = views.lens[0, k] + EXPECTED_DEPTH * views.bearings[0, n, k]
    if _is_negligible(views, root, start):
        return parts, False
    points = start.copy()
    own = np.zeros(size)  # the parts in their own deviations
    lens, bearings, backs = views.lens.copy(), views.bearings.copy(), np.zeros_like(views.rotations)
    normal, right = np.zeros((6 + size, 6 + size)), np.zeros(6 + size)
    factor, step = np.zeros((6 + size, 6 + size)), np.zeros(6 + size)
    for turn in range(PASSES):
        if turn > 0:
            take_error(views, parts, lens, bearings, backs)
        _fill_normal(views, lens, bearings, root, (points, start), own, normal, right)
        if not cholesky(normal, factor):
            return np.full(size, np.nan), True
        solve_factored(factor, right, step)
        for k in range(6):
            points[k // 3, k % 3] += step[k]
        for k in range(size):
            own[k] += step[6 + k]
        parts = root @ own
    return parts, True


@compiled
def _is_negligible(views: SharedViews, root: Array, points: Array) -> bool:
    """Whether what the error may do to any ray is small beside its noise."""
    aside = np.zeros((3, root.shape[0]))
    for i in range(views.lens.shape[0]):
        for n in range(2):
            length = norm(subtract(row(points, n), row(views.lens, i)))
            _write_aside(views, i, n, row(views.bearings[i], n), length, aside)
            _apply_root(aside, root)
            squared = 0.0
            for k in range(3):
                for column in range(root.shape[0]):
                    squared += aside[k, column] ** 2
            # An axis of the image, of two.
            if squared / 2.0 > NEGLIGIBLE**2 * _variance(views, i, n, length):
                return False
    return True


@compiled
def _variance(views: SharedViews, i: int, n: int, length: float) -> float:
    """Variance [m^2] across a ray at the length [m] of a point, of image, lens and rotation."""
    angle = views.image_variances[i, n] + views.rotation_variances[i]
    return float(angle * length**2 + views.lens_variances[i])


@compiled
def _write_aside(views: SharedViews, i: int, n: int, bearing: Vector, length: float, aside: Array) -> None:
    """Write (3, 7 + k): where the end of a ray of a length [m] goes with each part of the error."""
    rotation = views.rotations[i]
    for j in range(3):
        axis = (rotation[0, j], rotation[1, j], rotation[2, j])
        turned = scale(length, cross(axis, bearing))
        for k in range(3):
            aside[k, j] = rotation[k, j] - views.rotation[k, j]
            aside[k, 3 + j] = turned[k]
    turning = scale(length, cross(vector(views.motions[i, 3:]), bearing))
    for k in range(3):
        aside[k, 6] = views.motions[i, k] - views.motion[k] + turning[k]
        for j in range(aside.shape[1] - 7):
            aside[k, 7 + j] = length * views.camera_errors[i, n, k, j]


@compiled
def _apply_root(aside: Array, root: Array) -> None:
    """Turn changes (3, 7 + k) by the parts into those by their deviations; the root has blocks."""
    for k in range(3):
        by_lens = (aside[k, 0], aside[k, 1], aside[k, 2], aside[k, 3], aside[k, 4], aside[k, 5])
        for column in range(6):
            value = 0.0
            for j in range(6):
                value += by_lens[j] * root[j, column]
            aside[k, column] = value
        aside[k, 6] *= root[6, 6]


@compiled
def _fill_normal(
    views: SharedViews,
    lens: Array,
    bearings: Array,
    root: Array,
    points_and_start: tuple[Array, Array],
    own: Array,
    normal: Array,
    right: Array,
) -> None:
    """Write the normal equations (6 + 7 + k, ...) of steps of both points and of the parts in deviations.

    `lens` (N, 3) and `bearings` (N, 2, 3) are those without the error so far, `own` (7 + k,). What is left
    over is off + across moved + by_error step: an error that is there still moves the rays away from the
    points.
    """
    points, start = points_and_start
    size = own.size
    normal[:, :], right[:] = 0.0, 0.0
    for k in range(size):
        normal[6 + k, 6 + k], right[6 + k] = 1.0, -own[k]
    aside = np.zeros((3, size))
    for n in range(2):
        for k in range(3):
            normal[3 * n + k, 3 * n + k] = 1.0 / DEPTH_SIGMA**2
            right[3 * n + k] = -(points[n, k] - start[n, k]) / DEPTH_SIGMA**2
        for i in range(lens.shape[0]):
            ray = subtract(row(points, n), row(lens, i))
            length, bearing = norm(ray), row(bearings[i], n)
            weight = 1.0 / _variance(views, i, n, length)
            _write_aside(views, i, n, bearing, length, aside)
            _apply_root(aside, root)
            off = subtract(ray, scale(dot(bearing, ray), bearing))
            for column in range(size):
                moved = (aside[0, column], aside[1, column], aside[2, column])
                moved = subtract(moved, scale(dot(bearing, moved), bearing))
                aside[0, column], aside[1, column], aside[2, column] = moved
                right[6 + column] -= weight * dot(moved, off)
                for k in range(3):
                    normal[6 + column, 3 * n + k] += weight * moved[k]
                for other in range(column + 1):
                    normal[6 + column, 6 + other] += weight * (
                        moved[0] * aside[0, other] + moved[1] * aside[1, other] + moved[2] * aside[2, other]
                    )
            for k in range(3):
                right[3 * n + k] -= weight * off[k]
                for j in range(k + 1):
                    across = (1.0 if j == k else 0.0) - bearing[j] * bearing[k]
                    normal[3 * n + k, 3 * n + j] += weight * across


@compiled
def moved_points(
    views: SharedViews, points: Array, used: Mask, seconds: Array, rates: tuple[float, float, float]
) -> tuple[Array, bool]:
    """`CalibrationError._moved_points` on plain arrays, and whether the rays meet; `rates` are its last."""
    drift, angular_drift, by_scale = rates[0] / np.sqrt(3.0), rates[1] / np.sqrt(3.0), rates[2]
    errors = views.camera_errors.shape[3]
    count, last = 7 + errors + 7, views.lens.shape[0] - 1
    moved = np.zeros((6, count))
    normal, factor, right = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((count, 3))
    aside = np.zeros((count, 3))
    solution = np.zeros(3)
    for n in range(2):
        normal[:, :], right[:, :] = 0.0, 0.0
        for i in range(views.lens.shape[0]):
            if not used[i, n]:
                continue
            ray = subtract(row(points, n), row(views.lens, i))
            length = norm(ray)
            bearing = scale(1.0 / length, ray)
            variance = views.image_variances[i, n] + views.rotation_variances[i]
            weight = 1.0 / ((variance + views.lens_variances[i] / length**2) * length**2)
            rotation, motion = views.rotations[i], views.motions[i]
            for j in range(3):
                axis = (rotation[0, j], rotation[1, j], rotation[2, j])
                turned = scale(length, cross(axis, bearing))
                for k in range(3):
                    aside[j, k] = axis[k] - views.rotation[k, j]
                    aside[3 + j, k] = turned[k]
                    crept = axis[k] * seconds[i] - views.rotation[k, j] * seconds[last]
                    aside[7 + errors + j, k] = drift * crept
                    aside[10 + errors + j, k] = angular_drift * seconds[i] * turned[k]
            # A lens that moves takes its ray along; a bearing b that turns by r goes by r x b.
            turning = scale(length, cross(vector(motion[3:]), bearing))
            for k in range(3):
                aside[6, k] = motion[k] - views.motion[k] + turning[k]
                for j in range(errors):
                    aside[7 + j, k] = length * views.camera_errors[i, n, k, j]
                aside[13 + errors, k] = by_scale * (views.lens[i, k] - views.lens[last, k])
                for j in range(3):
                    normal[k, j] += weight * ((1.0 if j == k else 0.0) - bearing[j] * bearing[k])
            for column in range(count):
                along = dot(row(aside, column), bearing)
                for k in range(3):
                    right[column, k] += weight * (aside[column, k] - along * bearing[k])
        if not cholesky(normal, factor):
            return moved, False
        for column in range(count):
            solve_factored(factor, right[column], solution)
            for k in range(3):
                moved[3 * n + k, column] = solution[k]
    return moved, True
