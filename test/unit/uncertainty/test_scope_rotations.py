"""A scope that is turned in its camera head: what that does to a calibration's error, and who reports it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from travelling_scope import POINTS, estimates, observed, reported, scope, spread

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.inputs.scope_rotations import RotationRefusal, ScopeRotation, ScopeRotations
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances
from knee_gap_uncertainty.scope_calibration.posed_view import PosedView, posed_view
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError

EXACT = EstimatorParameters(**EXACT_SCOPE)

SHIFT = np.diag([1e-6, 1e-6, 0, 0, 0, 0])


def rotated_scope(count: int, oblique: float, wrong: Array, turn: float = 0.6) -> Views:
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
        scope_rotations=turns,
    )


@pytest.mark.parametrize("oblique", [0.0, np.radians(30.0)])
@pytest.mark.parametrize("axis", range(6))
def test_a_scope_turned_in_its_camera_head_turns_the_error_too(axis: int, oblique: float) -> None:
    size = 3e-4 if axis < 3 else 2e-3
    wrong = np.zeros(6)
    wrong[axis] = size
    shown = (
        abs(fit(rotated_scope(20, oblique, wrong)).gap - fit(rotated_scope(20, oblique, -wrong)).gap) / 2.0
    )
    covariance = np.diag(wrong**2)
    reported = spread(covariance, 0.0, rotated_scope(20, oblique, np.zeros(6)))
    assert reported == pytest.approx(shown, rel=0.15, abs=2e-6)


def test_the_bounds_hold_a_shift_that_the_turned_scope_carries_about() -> None:
    """The picture of a straight scope does not turn with it, and the lens that is off its axis goes round."""
    views = rotated_scope(2, 0.0, np.zeros(6), turn=0.5)
    first, present = (posed(views, k) for k in (0, 1))
    shift = 1e-4
    _, position = CalibrationError(np.diag([shift**2, 0, 0, 0, 0, 0]), 0.0).bounds(first, present, 1.0)
    assert position == pytest.approx(shift * np.sin(0.5), rel=1e-6)


def posed(views: Views, k: int) -> PosedView:
    """One of the views as the estimator makes it of an image and a pose."""
    assert views.scope_rotations is not None
    edges, pose = observed(views, k, 1)
    return posed_view(edges, replace(pose, scope_rotation=float(views.scope_rotations[k])), 3.0)


def test_the_estimator_is_told_how_far_the_scope_is_turned() -> None:
    """A millimetre of the lens on its body is nothing to a scope never turned, and much to one that is."""
    shift = reported("tracking_node", "a" * 64, error=np.diag([1e-6, 1e-6, 0, 0, 0, 0]))
    steady = estimates(shift, turning=0.0)[-1]
    assert steady.gap_max - steady.gap_min == pytest.approx(
        estimates(turning=0.0)[-1].gap_max - estimates(turning=0.0)[-1].gap_min
    )
    turned = estimates(shift, turning=0.0, scope_rotation=0.2)[-1]
    assert turned.gap == pytest.approx(steady.gap)
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(turned, low) < getattr(steady, low)
        assert getattr(turned, high) > getattr(steady, high)


def test_turns_are_kept_by_their_stamps_and_never_taken_from_afar() -> None:
    turns = ScopeRotations(max_age=2e-8)
    assert turns.at(5) is RotationRefusal.NOT_YET
    for stamp in range(1000):
        turns.add(ScopeRotation(10 * stamp, 1e-3 * stamp))
    assert turns.at(9_000) == pytest.approx(0.9)
    assert turns.at(9_004) == pytest.approx(0.9004)
    assert turns.at(0) is RotationRefusal.NONE_NEAR  # forgotten meanwhile
    assert turns.add(ScopeRotation(10_000, float("nan"))) is RotationRefusal.NOT_FINITE
    assert turns.add(ScopeRotation(10_000, 25.0)) is RotationRefusal.TOO_LARGE
    assert turns.at(10_000) is RotationRefusal.NOT_YET
    turns.add(ScopeRotation(10_050, 1.0))
    assert turns.at(10_000) is RotationRefusal.NONE_NEAR
    turns.add(ScopeRotation(20, 3.1))  # a bag that starts again
    assert turns.at(9_000) is RotationRefusal.NOT_YET
    turns.add(ScopeRotation(30, -3.1))  # the shorter way round
    assert turns.at(25) == pytest.approx(np.pi)


def turned_estimates(
    turn_at: Callable[[int], float | None], *, followed: bool = False, late: bool = False, shift: int = 0
) -> tuple[list[GapEstimate], GapEstimator]:
    """Estimates of 40 views, a rotation reported with each where `turn_at` has one; `late`: last."""
    estimator, views, found = GapEstimator(replace(EXACT, least_baseline_share=0.0)), scope(40, 0.0), []
    estimator.add_calibration(
        replace(reported("tracking_node", "a" * 64, error=SHIFT), rotation_followed=followed)
    )
    for k in range(40):
        stamp_ns = 10**18 + k * 10_000_000
        edges, pose = observed(views, k, stamp_ns)
        turn = turn_at(k)
        if turn is not None and not late:
            found += estimator.add_rotation(ScopeRotation(stamp_ns + shift, turn), stamp_ns)
        found += estimator.add_pose(pose, stamp_ns)
        found += estimator.add_edges(edges, stamp_ns)
        if turn is not None and late:
            found += estimator.add_rotation(ScopeRotation(stamp_ns + shift, turn), stamp_ns)
    found += estimator.advance(stamp_ns + 10**8)
    return [one for one in found if one.status is not GapStatus.NO_EDGES], estimator


def test_an_image_without_a_turn_is_not_valid_where_turns_are_told() -> None:
    for followed in (False, True):
        found, estimator = turned_estimates(lambda k: 0.005 * k if k < 20 else None, followed=followed)
        assert len(found) == 40
        assert {one.status for one in found[20:]} == {GapStatus.OUT_OF_SYNC}
        assert "scope_rotation" in found[-1].reason
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
    assert estimator.counts[f"scope_rotation refused: {RotationRefusal.NOT_FINITE.value}"] == 40


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
