"""The shared error of a calibration: what a refit with a wrong scope shows, whatever the views."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_uncertainty.estimator import GapEstimator
from knee_gap_uncertainty.gap_estimate import EdgeObservation, GapEstimate, GapStatus
from knee_gap_uncertainty.multi_view import fit
from knee_gap_uncertainty.pose_buffer import LensPose
from knee_gap_uncertainty.posed_view import PosedView, posed_view
from knee_gap_uncertainty.scope_calibration import CalibrationError, ScopeCalibration, contradiction
from knee_gap_uncertainty.scope_turns import ScopeTurn, ScopeTurns
from knee_gap_uncertainty.views import Views, bearing_covariances, isotropic_covariances

Array = npt.NDArray[np.float64]

POINTS = np.array([[0.002, -0.002, 0.012], [0.001, 0.0021, 0.011]])
NOTHING = np.zeros((6, 6))


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


@pytest.mark.parametrize("axis", range(7))
def test_it_is_what_a_refit_with_a_wrong_scope_shows(axis: int) -> None:
    size = [3e-4, 3e-4, 3e-4, 2e-3, 2e-3, 2e-3, 2e-3][axis]
    wrong = np.zeros(7)
    wrong[axis] = size
    shown = abs(fit(scope(20, wrong=wrong)).gap - fit(scope(20, wrong=-wrong)).gap) / 2.0
    covariance = NOTHING.copy()
    if axis < 6:
        covariance[axis, axis] = size**2
    told = spread(covariance, size if axis == 6 else 0.0, scope(20))
    assert told == pytest.approx(shown, rel=0.15, abs=2e-6)


def test_a_shift_is_not_felt_by_a_scope_that_does_not_turn() -> None:
    covariance = np.diag([1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0])  # a millimetre
    assert spread(covariance, 0.0, scope(20, turning=0.0)) < 1e-9
    assert spread(covariance, 0.0, scope(20, turning=0.3)) > 1e-5


def turned_scope(count: int, oblique: float, wrong: Array, turn: float = 0.6) -> Views:
    """Perfect views of a scope that travels 4 mm while it is turned in its camera head by +- `turn`.

    T_body_lens(turn) = S(turn) T_body_lens(0) Rz(-turn), the axis of S 1 mm beside the lens; of
    T_body_lens(0) a scope that is `wrong` (6,), a shift [m] and a rotation [rad] in the lens's own axes, is
    known.
    """
    turns = np.linspace(-turn, turn, count)
    tilt, axis_point = Rotation.from_rotvec([oblique, 0.0, 0.0]), np.array([0.001, 0.0, 0.0])
    lenses, rotations, bearings = [], [], []
    for share, angle in zip(np.linspace(0.0, 1.0, count), turns, strict=True):
        S, back = Rotation.from_rotvec([0.0, 0.0, angle]), Rotation.from_rotvec([0.0, 0.0, -angle])
        # The camera head only travels; it is turned so that the lens looks ahead at turn 0.
        head = tilt.inv()
        lens = share**2 * np.array([0.004, 0.0005, 0.0])
        rotation = head * S * tilt * back
        offset = S.apply(-axis_point) + axis_point  # of the lens in the head
        at_head = lens - head.apply(offset)
        towards = POINTS - lens
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        seen = rotation.inv().apply(towards)
        known = head * S * tilt * Rotation.from_rotvec(wrong[3:]) * back
        lenses.append(at_head + head.apply(offset + S.apply(tilt.apply(wrong[:3]))))
        rotations.append(known.as_matrix())
        bearings.append(known.apply(seen))
    return Views(
        np.array(lenses),
        np.array(bearings),
        bearing_covariances(np.array(bearings), 2e-3),
        isotropic_covariances(count, 2e-5),
        isotropic_covariances(count, 1e-4),
        lens_rotations=np.array(rotations),
        scope_turns=turns,
    )


@pytest.mark.parametrize("oblique", [0.0, np.radians(30.0)])
@pytest.mark.parametrize("axis", range(6))
def test_a_scope_turned_in_its_camera_head_turns_the_error_too(axis: int, oblique: float) -> None:
    size = 3e-4 if axis < 3 else 2e-3
    wrong = np.zeros(6)
    wrong[axis] = size
    shown = abs(fit(turned_scope(20, oblique, wrong)).gap - fit(turned_scope(20, oblique, -wrong)).gap) / 2.0
    covariance = np.diag(wrong**2)
    told = spread(covariance, 0.0, turned_scope(20, oblique, np.zeros(6)))
    assert told == pytest.approx(shown, rel=0.15, abs=2e-6)


def test_the_bounds_hold_a_shift_that_the_turned_scope_carries_about() -> None:
    """The picture of a straight scope does not turn with it, and the lens that is off its axis goes round."""
    views = turned_scope(2, 0.0, np.zeros(6), turn=0.5)
    first, present = (posed(views, k) for k in (0, 1))
    shift = 1e-4
    _, position = CalibrationError(np.diag([shift**2, 0, 0, 0, 0, 0]), 0.0).bounds(first, present, 1.0)
    assert position == pytest.approx(shift * np.sin(0.5), rel=1e-6)


def posed(views: Views, k: int) -> PosedView:
    """One of the views as the estimator makes it of an image and a pose."""
    assert views.lens_rotations is not None
    assert views.scope_turns is not None
    bearings = views.bearings[k] @ views.lens_rotations[k]
    edges = EdgeObservation(1, 1, True, bearings, bearing_covariances(bearings, 2e-3), angular_error=6e-3)
    quaternion = Rotation.from_matrix(views.lens_rotations[k]).as_quat()
    pose = LensPose(1, "world", views.lens_positions[k], quaternion, np.diag([1e-10] * 3 + [1e-9] * 3))
    return posed_view(edges, replace(pose, scope_turn=float(views.scope_turns[k])), 3.0)


def test_the_estimator_is_told_how_far_the_scope_is_turned() -> None:
    """A millimetre of the lens on its body is nothing to a scope never turned, and much to one that is."""
    shift = told("tracking_node", "a" * 64, error=np.diag([1e-6, 1e-6, 0, 0, 0, 0]))
    steady = estimates(shift, turning=0.0)[-1]
    assert steady.gap_max - steady.gap_min == pytest.approx(
        estimates(turning=0.0)[-1].gap_max - estimates(turning=0.0)[-1].gap_min
    )
    turned = estimates(shift, turning=0.0, scope_turn=0.2)[-1]
    assert turned.gap == pytest.approx(steady.gap)
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(turned, low) < getattr(steady, low)
        assert getattr(turned, high) > getattr(steady, high)


def test_turns_are_kept_by_their_stamps() -> None:
    turns = ScopeTurns()
    assert turns.at(5) == 0.0
    for stamp in range(1000):
        turns.add(ScopeTurn(10 * stamp, 1e-3 * stamp))
    assert turns.at(9_004) == pytest.approx(0.9)
    assert turns.at(9_006) == pytest.approx(0.901)
    turns.add(ScopeTurn(10_000, float("nan")))
    assert turns.at(20_000) == pytest.approx(0.999)
    turns.add(ScopeTurn(20, 0.5))  # a bag that starts again
    assert turns.at(9_000) == 0.5


def test_it_does_not_average_out() -> None:
    covariance = np.diag([4e-8, 4e-8, 4e-8, 4e-6, 4e-6, 4e-6])
    few, many = (spread(covariance, 1e-3, scope(count)) for count in (10, 200))
    assert many > 0.8 * few
    assert fit(scope(200)).gap_deviation < 0.8 * fit(scope(10)).gap_deviation


def test_it_counts_as_common_and_shares_still_sum_to_one() -> None:
    views = scope(30)
    fitted = fit(views)
    wider = CalibrationError(np.diag([4e-8] * 3 + [1e-4] * 3), 0.0).widened(fitted, views)
    assert wider.shares.sum() == pytest.approx(1.0)
    assert wider.shares[3] > fitted.shares[3]


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


@pytest.mark.parametrize("column", range(3))
def test_the_cameras_error_is_what_a_refit_with_a_wrong_camera_shows(column: int) -> None:
    views = scope(20)
    errors = camera_errors(views, column)
    gaps = []
    for sign in (1.0, -1.0):
        wrong = views.bearings + sign * errors[..., 0]
        gaps.append(fit(replace(views, bearings=wrong / np.linalg.norm(wrong, axis=-1, keepdims=True))).gap)
    shown = abs(gaps[0] - gaps[1]) / 2.0
    assert spread(NOTHING, 0.0, replace(views, camera_errors=errors)) == pytest.approx(
        shown, rel=0.15, abs=2e-6
    )


def test_the_cameras_errors_add_as_independent_ones_do() -> None:
    views = scope(20)
    one = [spread(NOTHING, 0.0, replace(views, camera_errors=camera_errors(views, k))) for k in range(3)]
    together = spread(NOTHING, 0.0, replace(views, camera_errors=camera_errors(views, 0, 1, 2)))
    assert together == pytest.approx(np.sqrt(np.sum(np.square(one))), rel=1e-6)


def told(node: str, digest: str, *, error: Array | None = None) -> ScopeCalibration:
    return ScopeCalibration(node, digest, np.full((6, 6), np.nan) if error is None else error, 0.0)


def test_nodes_with_different_calibrations_contradict_each_other() -> None:
    one, other, none = told("tracking_node", "a" * 64), told("segmentation_node", "b" * 64), told("x", "")
    assert not contradiction({"tracking_node": one})
    assert not contradiction({"tracking_node": one, "segmentation_node": replace(other, hash="a" * 64)})
    words = contradiction({"tracking_node": one, "segmentation_node": other})
    assert "segmentation_node bbbbbbbbbbbb, tracking_node aaaaaaaaaaaa" in words
    assert "x none" in contradiction({"tracking_node": one, "x": none})


def estimates(
    *calibrations: ScopeCalibration, camera: float = 0.0, turning: float = 0.3, scope_turn: float = 0.0
) -> list[GapEstimate]:
    """What the estimator says of 40 views of the travelling scope, `camera` times its errors told.

    It turns in its camera head by `scope_turn` [rad] on the way.
    """
    estimator, views, found = GapEstimator(), scope(40, turning), []
    errors = camera * camera_errors(views, 0, 1, 2)
    for calibration in calibrations:
        estimator.add_calibration(calibration)
    assert views.lens_rotations is not None
    for k in range(40):
        stamp_ns = 10**18 + k * 10_000_000
        rotation = views.lens_rotations[k]
        bearings = views.bearings[k] @ rotation
        edges = EdgeObservation(
            stamp_ns, 1, True, bearings, bearing_covariances(bearings, 2e-3), angular_error=6e-3,
            camera_errors=np.einsum("ij,kic->kjc", rotation, errors[k]),
        )  # fmt: skip
        pose = LensPose(
            stamp_ns,
            "world",
            views.lens_positions[k],
            Rotation.from_matrix(rotation).as_quat(),
            np.diag([1e-10] * 3 + [1e-9] * 3),
        )
        if scope_turn:
            estimator.add_turn(ScopeTurn(stamp_ns, scope_turn * k / 39))
        estimator.add_pose(pose, stamp_ns)
        found += estimator.add_edges(edges, stamp_ns)
    return found


def test_nothing_is_valid_while_the_nodes_contradict_each_other() -> None:
    same = estimates(told("tracking_node", "a" * 64), told("segmentation_node", "a" * 64))
    assert any(estimate.status is GapStatus.VALID for estimate in same)
    different = estimates(told("tracking_node", "a" * 64), told("segmentation_node", ""))
    assert {estimate.status for estimate in different} == {GapStatus.UNKNOWN}
    assert "different calibrations" in different[-1].reason


def test_both_intervals_include_the_calibrations_error() -> None:
    without = estimates()[-1]
    poor = np.diag([1e-8] * 3 + [1e-5] * 3)
    with_it = estimates(told("tracking_node", "a" * 64, error=poor))[-1]
    assert with_it.status is without.status is GapStatus.VALID
    assert with_it.gap == pytest.approx(without.gap)
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(with_it, low) < getattr(without, low)
        assert getattr(with_it, high) > getattr(without, high)


def test_both_intervals_include_the_cameras_error() -> None:
    exact = told("tracking_node", "a" * 64, error=NOTHING)
    without, with_it = estimates(exact)[-1], estimates(exact, camera=3.0)[-1]
    assert with_it.status is without.status is GapStatus.VALID
    assert with_it.gap == pytest.approx(without.gap)
    assert with_it.shares[3] > without.shares[3]
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(with_it, low) < getattr(without, low)
        assert getattr(with_it, high) > getattr(without, high)


def test_errors_of_a_camera_that_are_none_give_no_estimate() -> None:
    wrong = estimates(told("tracking_node", "a" * 64, error=NOTHING), camera=float("nan"))
    assert {estimate.status for estimate in wrong} == {GapStatus.NO_EDGES}
