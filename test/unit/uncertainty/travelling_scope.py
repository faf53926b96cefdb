"""A scope that travels, for tests of the errors that all its views share."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.inputs.scope_rotations import ScopeRotation
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError, ScopeCalibration

EXACT = EstimatorParameters(**EXACT_SCOPE)


POINTS = np.array([[0.002, -0.002, 0.012], [0.001, 0.0021, 0.011]])
NOTHING = np.zeros((6, 6))
NO_ERRORS = np.zeros((2, 3, 0))


def scope(count: int, turning: float = 0.3, wrong: Array | None = None) -> Views:
    """Perfect views from a lens that travels 4 mm and turns, as seen with a scope that is `wrong`.

    `wrong` (7,): shift [m] and rotation [rad] of the lens on its body, and of the clock [s].
    """
    error = np.zeros(7) if wrong is None else wrong
    share = np.linspace(0.0, 1.0, count)
    lens = np.outer(share**2, [0.004, 0.0005, 0.0])
    motions = np.zeros((count, 6))
    motions[:, :3] = 0.01 * 2.0 * share[:, None] * [0.4, 0.05, 0.0]
    motions[:, 3:] = [0.0, 0.2, 0.1]
    rotations = Rotation.from_rotvec(np.outer(share, [0.4 * turning, turning, 0.2 * turning])).as_matrix()
    towards = POINTS - lens[:, None]
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    turn = np.einsum("nij,j->ni", rotations, error[3:6]) + motions[:, 3:] * error[6]
    bearings = np.einsum("nij,nkj->nki", Rotation.from_rotvec(turn).as_matrix(), bearings)
    shift = np.einsum("nij,j->ni", rotations, error[:3]) + motions[:, :3] * error[6]
    return Views(
        lens + shift,
        bearings,
        bearing_covariances(bearings, 2e-3),
        isotropic_covariances(count, 2e-5),
        isotropic_covariances(count, 1e-4),
        lens_rotations=rotations,
        lens_motions=motions,
    )


def spread(covariance: Array, clock: float, views: Views) -> float:
    """Standard deviation of the gap that the shared error alone gives [m]."""
    fitted = fit(views)
    wider = CalibrationError(covariance, clock).widened(fitted, views)
    return float(np.sqrt(max(wider.gap_deviation**2 - fitted.gap_deviation**2, 0.0)))


def reported(node: str, digest: str, *, error: Array | None = None) -> ScopeCalibration:
    return ScopeCalibration(node, digest, np.full((6, 6), np.nan) if error is None else error, 0.0)


def camera_errors(views: Views, *columns: int) -> Array:
    """Displacements (N, 2, 3, k) by errors of an equidistant lens: x and y of the picture, its scale.

    A column's one standard deviation is 1 mrad, or 1 % of the angle to the axis.
    """
    rotations = views.lens_rotations
    assert rotations is not None
    bearings = np.einsum("nij,nki->nkj", rotations, views.bearings)
    across = np.linalg.norm(bearings[..., :2], axis=-1)
    out = np.zeros_like(bearings)
    out[..., :2] = bearings[..., :2] / across[..., None]
    along = np.cross(np.cross(bearings, out), bearings)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    moved = np.zeros((*bearings.shape, 3))
    for axis in (0, 1):
        unit = np.eye(3)[axis]
        moved[..., axis] = 1e-3 * (unit - (bearings @ unit)[..., None] * bearings)
    moved[..., 2] = 1e-2 * np.arctan2(across, bearings[..., 2])[..., None] * along
    return np.asarray(np.einsum("nij,nkjc->nkic", rotations, moved[..., list(columns)]))


def observed(views: Views, k: int, stamp_ns: int, errors: Array = NO_ERRORS) -> tuple[GapEdges, LensPose]:
    """One of the views as it is reported to the estimator: the edges in an image, and the pose of the lens.

    `errors` (2, 3, n) are what the camera's own errors do to the bearings, in the frame of the views.
    """
    assert views.lens_rotations is not None
    rotation = views.lens_rotations[k]
    bearings = views.bearings[k] @ rotation
    edges = replace(
        GapEdges.of_points(stamp_ns, 1, bearings, bearing_covariances(bearings, 2e-3), angular_error=6e-3),
        camera_errors=np.einsum("ij,kic->kjc", rotation, errors),
    ).with_rims_at_points()
    quaternion = Rotation.from_matrix(rotation).as_quat()
    covariance = np.diag([1e-10] * 3 + [1e-9] * 3)
    return edges, LensPose(stamp_ns, "world", views.lens_positions[k], quaternion, covariance)


def estimates(
    *calibrations: ScopeCalibration,
    camera: float | None = 0.0,
    turning: float = 0.3,
    scope_rotation: float = 0.0,
    parameters: EstimatorParameters = EXACT,
) -> list[GapEstimate]:
    """Estimates of 40 views of the travelling scope, with `camera` times its errors reported.

    None: no error of the camera is reported. It turns in its camera head by `scope_rotation` [rad].
    """
    estimator, views, found = GapEstimator(parameters), scope(40, turning), []
    errors = np.zeros((40, 2, 3, 0)) if camera is None else camera * camera_errors(views, 0, 1, 2)
    for calibration in calibrations:
        estimator.add_calibration(calibration)
    for k in range(40):
        stamp_ns = 10**18 + k * 10_000_000
        edges, pose = observed(views, k, stamp_ns, errors[k])
        if scope_rotation:
            found += estimator.add_rotation(ScopeRotation(stamp_ns, scope_rotation * k / 39), stamp_ns)
        estimator.add_pose(pose, stamp_ns)
        found += estimator.add_edges(edges, stamp_ns)
    return found


# Errors far below any tracker's: only the rules stand between a short travel and VALID.
TINY = EstimatorParameters(
    **EXACT_SCOPE, tracker_drift=0.0, tracker_angular_drift=0.0, unproven_drift=0.0, tracker_scale=0.0
)


def travelling(
    estimator: GapEstimator, depth: float, travel: float, count: int = 40, sigma: float = 1e-5
) -> list[GapEstimate]:
    """Images from a lens that travels past two points, 4 mm apart at a depth [m]."""
    points, found = np.array([[0.0, -0.002, depth], [0.0, 0.002, depth]]), []
    for k, x in enumerate(np.linspace(0.0, travel, count)):
        stamp = 10**9 + k * 16_666_667
        place = np.array([x + 1e-10 * k, 0.0, 0.0])
        pose = LensPose(stamp, "world", place, Rotation.identity().as_quat(), np.diag([1e-16] * 6))
        bearings = points - place
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        edges = GapEdges.of_points(stamp, 1, bearings, bearing_covariances(bearings, sigma), 3.0 * sigma)
        estimator.add_pose(pose, stamp)
        found += estimator.add_edges(edges.with_rims_at_points(), stamp)
    return found
