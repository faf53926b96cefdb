"""The shared error of a calibration: what a refit with a wrong scope shows, whatever the views."""

from collections.abc import Callable
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
from knee_gap_uncertainty.scope_turns import ScopeTurn, ScopeTurns, TurnRefusal
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


def test_turns_are_kept_by_their_stamps_and_never_taken_from_afar() -> None:
    turns = ScopeTurns(max_age=2e-8)
    assert turns.at(5) is TurnRefusal.NOT_YET
    for stamp in range(1000):
        turns.add(ScopeTurn(10 * stamp, 1e-3 * stamp))
    assert turns.at(9_000) == pytest.approx(0.9)
    assert turns.at(9_004) == pytest.approx(0.9004)
    assert turns.at(0) is TurnRefusal.NONE_NEAR  # forgotten meanwhile
    assert turns.add(ScopeTurn(10_000, float("nan"))) is TurnRefusal.NOT_FINITE
    assert turns.add(ScopeTurn(10_000, 25.0)) is TurnRefusal.TOO_LARGE
    assert turns.at(10_000) is TurnRefusal.NOT_YET
    turns.add(ScopeTurn(10_050, 1.0))
    assert turns.at(10_000) is TurnRefusal.NONE_NEAR
    turns.add(ScopeTurn(20, 3.1))  # a bag that starts again
    assert turns.at(9_000) is TurnRefusal.NOT_YET
    turns.add(ScopeTurn(30, -3.1))  # the shorter way round
    assert turns.at(25) == pytest.approx(np.pi)


SHIFT = np.diag([1e-6, 1e-6, 0, 0, 0, 0])


def turned_estimates(
    turn_at: Callable[[int], float | None], *, followed: bool = False, late: bool = False, shift: int = 0
) -> tuple[list[GapEstimate], GapEstimator]:
    """What the estimator says of 40 views, a turn told with each where `turn_at` has one; `late`: last."""
    estimator, views, found = GapEstimator(), scope(40, 0.0), []
    estimator.add_calibration(replace(told("tracking_node", "a" * 64, error=SHIFT), turn_followed=followed))
    assert views.lens_rotations is not None
    for k in range(40):
        stamp_ns = 10**18 + k * 10_000_000
        rotation = views.lens_rotations[k]
        bearings = views.bearings[k] @ rotation
        edges = EdgeObservation(stamp_ns, 1, True, bearings, bearing_covariances(bearings, 2e-3), 6e-3)
        quaternion, covariance = Rotation.from_matrix(rotation).as_quat(), np.diag([1e-10] * 3 + [1e-9] * 3)
        pose = LensPose(stamp_ns, "world", views.lens_positions[k], quaternion, covariance)
        turn = turn_at(k)
        if turn is not None and not late:
            found += estimator.add_turn(ScopeTurn(stamp_ns + shift, turn), stamp_ns)
        found += estimator.add_pose(pose, stamp_ns)
        found += estimator.add_edges(edges, stamp_ns)
        if turn is not None and late:
            found += estimator.add_turn(ScopeTurn(stamp_ns + shift, turn), stamp_ns)
    found += estimator.advance(stamp_ns + 10**8)
    return [one for one in found if one.status is not GapStatus.NO_EDGES], estimator


def test_an_image_without_a_turn_is_not_valid_where_turns_are_told() -> None:
    for followed in (False, True):
        found, estimator = turned_estimates(lambda k: 0.005 * k if k < 20 else None, followed=followed)
        assert len(found) == 40
        assert {one.status for one in found[20:]} == {GapStatus.OUT_OF_SYNC}
        assert "scope_turn" in found[-1].reason
        assert estimator.counts[f"OUT_OF_SYNC: {found[-1].reason}"] == 20
        assert found[19].status is GapStatus.VALID


def test_an_image_without_a_turn_is_not_valid_where_the_node_says_that_it_follows_it() -> None:
    found, _ = turned_estimates(lambda _: None, followed=True)
    assert {one.status for one in found} == {GapStatus.OUT_OF_SYNC}
    assert turned_estimates(lambda _: None)[0][-1].status is GapStatus.VALID


def test_views_from_before_the_first_turn_are_not_compared_with_those_after_it() -> None:
    late, _ = turned_estimates(lambda k: 0.3 if k >= 30 else None)
    assert late[29].status is GapStatus.VALID
    assert late[30].status is not GapStatus.VALID
    assert late[30].baseline == 0.0


def test_a_turn_that_is_not_finite_is_counted_and_leaves_its_image_without() -> None:
    found, estimator = turned_estimates(lambda _: float("nan"))
    assert {one.status for one in found} == {GapStatus.OUT_OF_SYNC}
    assert estimator.counts[f"scope_turn refused: {TurnRefusal.NOT_FINITE.value}"] == 40


def test_an_image_waits_for_the_turn_that_comes_after_its_pose() -> None:
    soon, _ = turned_estimates(lambda k: 0.005 * k, followed=True)
    late, _ = turned_estimates(lambda k: 0.005 * k, followed=True, late=True)
    assert [one.stamp_ns for one in late] == [one.stamp_ns for one in soon]
    assert [one.gap_max for one in late[5:]] == [one.gap_max for one in soon[5:]]
    assert late[-1].status is GapStatus.VALID


def test_a_turn_between_two_that_are_told_is_as_good_as_one_told() -> None:
    exact, _ = turned_estimates(lambda k: 0.005 * k)
    between, _ = turned_estimates(lambda k: 0.005 * (k + 0.4), shift=4_000_000)
    assert between[-2].status is GapStatus.VALID
    # The first image, before the first turn, has none: the views begin a little later.
    assert between[-2].gap_max == pytest.approx(exact[-2].gap_max, rel=0.1)


GOOD = np.diag([1e-8] * 3 + [1e-5] * 3)
ONE_NAN = GOOD.copy()
ONE_NAN[0, 1] = np.nan


@pytest.mark.parametrize(
    ("covariance", "clock"),
    [
        (ONE_NAN, 0.0),
        (np.full((6, 6), np.inf), 0.0),
        (-GOOD, 1e-3),
        (np.diag([1e-8] * 3 + [3e-5, -1e-5, -1e-5]), 1e-3),
        (GOOD + np.triu(np.full((6, 6), 1e-9), 1), 1e-3),
        (GOOD + 2e-8 * (np.eye(6, k=1) + np.eye(6, k=-1)), 1e-3),
        (
            GOOD - 9e-9 * (np.ones((6, 6)) - np.eye(6)) * np.outer([1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0]),
            1e-3,
        ),
        (np.full((6, 6), 1e300), 0.0),
        (np.diag([1e8] * 3 + [1e-6] * 3), 0.0),
        (GOOD, -1.0),
        (GOOD, np.inf),
        (GOOD, 1e300),
        (np.full((6, 6), np.nan), np.inf),
    ],
)
def test_a_calibrations_error_that_is_none_leaves_nothing_valid(covariance: Array, clock: float) -> None:
    wrong = ScopeCalibration("tracking_node", "a" * 64, covariance, clock)
    assert "tracking_node" in wrong.flaw()
    found = estimates(wrong)
    assert {one.status for one in found} == {GapStatus.UNKNOWN}
    assert found[-1].reason == wrong.flaw()


@pytest.mark.parametrize("clock", [np.nan, 0.0])
def test_not_used_is_no_flaw(clock: float) -> None:
    nothing = ScopeCalibration("tracking_node", "a" * 64, np.full((6, 6), np.nan), clock)
    assert not nothing.flaw()
    assert nothing.error is None
    lens = replace(nothing, lens_covariance=GOOD)
    assert not lens.flaw()
    assert lens.error is not None
    assert lens.error.clock == 0.0
    clock_only = replace(nothing, time_offset_error=1e-3)
    assert clock_only.error is not None
    assert clock_only.error.clock == 1e-3


def test_a_covariance_that_was_rounded_in_a_file_is_one() -> None:
    column = np.array([1e-4, -2e-4, 1.5e-4, 1e-3, 2e-3, -1e-3])
    rounded = np.array([[float(f"{number:.7g}") for number in row] for row in np.outer(column, column)])
    assert not told("tracking_node", "a" * 64, error=rounded).flaw()


def test_another_error_under_the_same_hash_begins_a_new_track() -> None:
    estimator, views = GapEstimator(), scope(2, 0.0)
    assert views.lens_rotations is not None
    rotation = views.lens_rotations[0]
    bearings = views.bearings[0] @ rotation
    same = told("tracking_node", "a" * 64, error=GOOD)
    estimator.add_calibration(same)
    counts = []
    for k, calibration in enumerate((same, replace(same), replace(same, lens_covariance=2.0 * GOOD))):
        estimator.add_calibration(calibration)
        stamp_ns = 10**18 + k * 10_000_000
        place = views.lens_positions[0] + [1e-3 * k, 0.0, 0.0]
        quaternion, covariance = Rotation.from_matrix(rotation).as_quat(), np.diag([1e-10] * 3 + [1e-9] * 3)
        estimator.add_pose(LensPose(stamp_ns, "world", place, quaternion, covariance), stamp_ns)
        edges = EdgeObservation(stamp_ns, 1, True, bearings, bearing_covariances(bearings, 2e-3), 6e-3)
        counts += [one.baseline for one in estimator.add_edges(edges, stamp_ns)]
    assert counts == pytest.approx([0.0, 1e-3, 0.0])


@pytest.mark.parametrize("error", [np.diag([1e-2] * 3 + [1.0] * 3), np.zeros((6, 6))])
@pytest.mark.parametrize("clock", [0.0, 1.0])
@pytest.mark.parametrize("turning", [0.0, 0.3])
def test_the_largest_error_that_is_taken_gives_statuses(error: Array, clock: float, turning: float) -> None:
    found = estimates(
        replace(told("tracking_node", "a" * 64, error=error), time_offset_error=clock), turning=turning
    )
    assert len(found) == 40
    if clock or error.any():
        assert GapStatus.VALID not in {one.status for one in found}


def test_what_cannot_be_calculated_with_is_a_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("knee_gap_uncertainty.track.explained_by", singular)
    found = estimates(told("tracking_node", "a" * 64, error=GOOD))
    assert {one.status for one in found} == {GapStatus.UNKNOWN}
    assert "calculated" in found[-1].reason


def test_an_image_whose_velocity_is_unknown_is_not_taken_where_the_clock_is_uncertain() -> None:
    """The first image lies at the only pose there is then."""
    uncertain = replace(told("tracking_node", "a" * 64, error=GOOD), time_offset_error=1e-3)
    found = estimates(uncertain)
    assert found[0].status is GapStatus.OUT_OF_SYNC
    assert "how fast the lens moved" in found[0].reason
    assert found[1].status is not GapStatus.OUT_OF_SYNC
    assert estimates(told("tracking_node", "a" * 64, error=GOOD))[0].status is not GapStatus.OUT_OF_SYNC


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
            found += estimator.add_turn(ScopeTurn(stamp_ns, scope_turn * k / 39), stamp_ns)
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
