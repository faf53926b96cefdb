"""How much of a track's residuals the calibration's error explains: what it does is no motion of a joint.

The error is the same in all views, so it leaves a pattern in them: a lens that sits elsewhere on its body
shows as points that move when the scope turns. Points and error are fitted together, the error held to what
is stated of it, and the views are given back as they would be without it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError

PASSES = 3  # of Gauss and Newton: a degree of turn is not small beside a tenth of it
EXPECTED_DEPTH, DEPTH_SIGMA = 0.012, 0.02  # [m] of points, while the views do not determine it
# Of the noise of a bearing: what a calibration does below that is not worth a fit.
NEGLIGIBLE = 0.2


class SharedError(NamedTuple):
    """One value of the error: `parts` (7 + k,) are shift [m], turn [rad], clock [s] and camera [-].

    Shifts are counted from `rotation` (3, 3), `motion` (6,) of one view, at which they are 0: what moves all
    lenses alike moves the points with them.
    """

    parts: Array
    rotation: Array
    motion: Array

    def taken_from(self, views: Views) -> Views:
        """The views as they would be without it.

        Taking a clock's error from a lens puts the errors of the two poses that give its velocity in.
        """
        assert views.lens_rotations is not None
        motions = _motions(views)
        rotations = views.calibrated_rotations
        shift = (rotations - self.rotation) @ self.parts[:3]
        shift += (motions[:, :3] - self.motion[:3]) * self.parts[6]
        turn = rotations @ self.parts[3:6] + motions[:, 3:] * self.parts[6]
        back = Rotation.from_rotvec(-turn).as_matrix()
        bearings = views.bearings
        if views.camera_errors is not None:
            bearings = bearings - views.camera_errors @ self.parts[7:]
        bearings = np.einsum("nij,nkj->nki", back, bearings)
        times = np.full(len(views), np.inf) if views.motion_times is None else views.motion_times
        larger = 1.0 + 2.0 * (self.parts[6] / times[:, None, None]) ** 2
        return replace(
            views,
            lens_positions=views.lens_positions - shift,
            bearings=bearings / np.linalg.norm(bearings, axis=-1, keepdims=True),
            lens_covariances=larger * views.lens_covariances,
            rotation_covariances=larger * views.rotation_covariances,
            lens_rotations=back @ views.lens_rotations,
        )


def explained_by(error: CalibrationError, views: Views) -> SharedError | None:
    """The most likely value of the error by the views; None where it is too small to matter.

    Bearings and positions have the variances that the views state, the error that of `error`.
    """
    if len(views) < 2 or views.lens_rotations is None:
        return None
    none = np.zeros(7 + (0 if views.camera_errors is None else views.camera_errors.shape[-1]))
    shared = SharedError(none, views.calibrated_rotations[-1], _motions(views)[-1])
    root = error.root(len(none))
    points = views.lens_positions[0] + EXPECTED_DEPTH * views.bearings[0]
    if _is_negligible(views, shared, root, points):
        return None
    start = points
    for _ in range(PASSES):
        step, points = _step(views, shared, root, points, start)
        shared = shared._replace(parts=root @ step)
    return shared


def _step(views: Views, shared: SharedError, root: Array, points: Array, start: Array) -> tuple[Array, Array]:
    """(7 + k,) the error in its own standard deviations, and the points (2, 3), after a step."""
    present = shared.taken_from(views)
    size = root.shape[1]
    # The error so far, in the directions that it may have.
    before = np.linalg.lstsq(root, shared.parts, rcond=None)[0]
    normal, right = np.zeros((6 + size, 6 + size)), np.zeros(6 + size)
    normal[6:, 6:], right[6:] = np.eye(size), -before
    for n in range(2):
        ray = points[n] - present.lens_positions
        length = np.linalg.norm(ray, axis=1)
        bearing = present.bearings[:, n]
        across = np.eye(3) - bearing[:, :, None] * bearing[:, None, :]
        weight = 1.0 / _variances(views, n, length)
        by_error = across @ (_aside(views, shared, n, bearing, length) @ root)
        off = np.einsum("nij,nj->ni", across, ray)
        # What is left over is off + across moved + by_error step: an error that is there still moves the rays
        # away from the points.
        block = slice(3 * n, 3 * n + 3)
        normal[block, block] += np.einsum("n,nij->ij", weight, across)
        normal[block, 6:] += np.einsum("n,nij->ij", weight, by_error)
        normal[6:, 6:] += np.einsum("n,nki,nkj->ij", weight, by_error, by_error)
        right[block] -= weight @ off
        right[6:] -= np.einsum("n,nki,nk->i", weight, by_error, off)
        normal[block, block] += np.eye(3) / DEPTH_SIGMA**2
        right[block] -= (points[n] - start[n]) / DEPTH_SIGMA**2
        normal[6:, block] = normal[block, 6:].T
    moved = np.linalg.solve(normal, right)
    return before + moved[6:], points + moved[:6].reshape(2, 3)


def _aside(views: Views, shared: SharedError, n: int, bearing: Array, length: Array) -> Array:
    """(N, 3, 7 + k): where the end of a ray of a length [m] goes with each part of the error."""
    rotations = views.calibrated_rotations
    motions = _motions(views)
    aside = np.zeros((len(views), 3, len(shared.parts)))
    aside[:, :, :3] = rotations - shared.rotation
    aside[:, :, 3:6] = length[:, None, None] * np.cross(
        np.swapaxes(rotations, 1, 2), bearing[:, None, :]
    ).swapaxes(1, 2)
    turned = np.cross(motions[:, 3:], bearing) * length[:, None]
    aside[:, :, 6] = motions[:, :3] - shared.motion[:3] + turned
    if views.camera_errors is not None:
        aside[:, :, 7:] = length[:, None, None] * views.camera_errors[:, n]
    return aside


def _variances(views: Views, n: int, length: Array) -> Array:
    """(N,) variance [m^2] across a ray at the length [m] of a point, of image, lens and rotation."""
    image = np.trace(views.bearing_covariances[:, n], axis1=1, axis2=2) / 2.0
    turn = np.trace(views.rotation_covariances, axis1=1, axis2=2) / 3.0
    lens = np.trace(views.lens_covariances, axis1=1, axis2=2) / 3.0
    return np.asarray((image + turn) * length**2 + lens)


def _is_negligible(views: Views, shared: SharedError, root: Array, points: Array) -> bool:
    """Whether what the error may do to any ray is small beside its noise."""
    for n in range(2):
        length = np.linalg.norm(points[n] - views.lens_positions, axis=1)
        moved = _aside(views, shared, n, views.bearings[:, n], length) @ root
        # An axis of the image, of two.
        ratio = (moved**2).sum(axis=(1, 2)) / 2.0 / _variances(views, n, length)
        if ratio.max() > NEGLIGIBLE**2:
            return False
    return True


def _motions(views: Views) -> Array:
    return np.zeros((len(views), 6)) if views.lens_motions is None else views.lens_motions
