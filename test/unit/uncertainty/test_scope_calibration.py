"""The shared error of a calibration: what a refit with a wrong scope shows, whatever the views."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from travelling_scope import NOTHING, camera_errors, estimates, reported, scope, spread

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import bearing_covariances
from knee_gap_uncertainty.scope_calibration.scope_calibration import (
    CalibrationError,
    ScopeCalibration,
    contradiction,
    shared_error,
)

EXACT = EstimatorParameters(**EXACT_SCOPE)


@pytest.mark.parametrize("axis", range(7))
def test_it_is_what_a_refit_with_a_wrong_scope_shows(axis: int) -> None:
    size = [3e-4, 3e-4, 3e-4, 2e-3, 2e-3, 2e-3, 2e-3][axis]
    wrong = np.zeros(7)
    wrong[axis] = size
    shown = abs(fit(scope(20, wrong=wrong)).gap - fit(scope(20, wrong=-wrong)).gap) / 2.0
    covariance = NOTHING.copy()
    if axis < 6:
        covariance[axis, axis] = size**2
    reported = spread(covariance, size if axis == 6 else 0.0, scope(20))
    assert reported == pytest.approx(shown, rel=0.15, abs=2e-6)


def test_a_shift_is_not_felt_by_a_scope_that_does_not_turn() -> None:
    covariance = np.diag([1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0])  # a millimetre
    assert spread(covariance, 0.0, scope(20, turning=0.0)) < 1e-9
    assert spread(covariance, 0.0, scope(20, turning=0.3)) > 1e-5


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


def test_what_was_not_calibrated_has_the_errors_that_the_parameters_state() -> None:
    """Uncalibrated is wide, not silent: nothing is taken for exact because nobody stated its error."""
    limits = EstimatorParameters()
    nothing = ScopeCalibration("tracking_node", "a" * 64, np.full((6, 6), np.nan), np.nan)
    assert not nothing.flaw()
    lens = replace(nothing, lens_covariance=GOOD)
    clock = replace(nothing, time_offset_error=1e-3)
    without_hash = replace(clock, hash="", lens_covariance=GOOD)
    for told_ones in ([], [nothing], [without_hash], [replace(clock, lens_covariance=-GOOD)]):
        error = shared_error(told_ones, limits)
        assert error.clock == limits.clock_error
        assert np.trace(error.covariance[:3, :3]) == pytest.approx(limits.lens_position_error**2)
        assert np.trace(error.covariance[3:, 3:]) == pytest.approx(limits.lens_rotation_error**2)
    assert shared_error([], limits).camera == shared_error([without_hash], limits).camera > 0.0
    assert shared_error([nothing], limits).camera == 0.0
    assert shared_error([nothing, lens], limits).covariance is GOOD
    assert shared_error([lens], limits).clock == limits.clock_error
    assert shared_error([nothing, clock], limits).clock == 1e-3


@pytest.mark.parametrize("name", list(EXACT_SCOPE))
def test_both_intervals_include_what_was_not_calibrated(name: str) -> None:
    exact = moving(EXACT)
    # A share of it: the whole leaves nothing valid of so short a track.
    wide = moving(replace(EXACT, **{name: 0.2 * getattr(EstimatorParameters(), name)}))
    assert exact.status is wide.status is GapStatus.VALID
    assert wide.gap == pytest.approx(exact.gap)
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(wide, low) < getattr(exact, low)
        assert getattr(wide, high) > getattr(exact, high)


def moving(parameters: EstimatorParameters) -> GapEstimate:
    """The last estimate of an uncalibrated scope that travels and turns, and states nothing of its camera."""
    return estimates(parameters=parameters, camera=None)[-1]


@pytest.mark.parametrize("axis", range(6))
def test_a_drift_is_what_a_refit_with_a_creeping_body_shows(axis: int) -> None:
    views = scope(20)
    views = replace(views, times=np.linspace(0.0, 2.0, 20))
    rates = np.zeros(6)
    rates[axis] = [1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3][axis]
    assert views.lens_rotations is not None
    assert views.times is not None
    crept = np.einsum("nij,j->ni", views.lens_rotations, rates[:3]) * views.times[:, None]
    turn = np.einsum("nij,j->ni", views.lens_rotations, rates[3:]) * views.times[:, None]
    gaps = []
    for sign in (1.0, -1.0):
        turned = Rotation.from_rotvec(sign * turn).as_matrix()
        bearings = np.einsum("nij,nkj->nki", turned, views.bearings)
        gaps.append(
            fit(replace(views, bearings=bearings, lens_positions=views.lens_positions + sign * crept)).gap
        )
    shown = abs(gaps[0] - gaps[1]) / 2.0
    fitted = fit(views)
    error = CalibrationError(NOTHING, 0.0, drift=np.sqrt(3) * 1e-4 if axis < 3 else 0.0)
    if axis >= 3:
        error = replace(error, angular_drift=np.sqrt(3) * 1e-3)
    told_variance = error.widened(fitted, views).gap_deviation ** 2 - fitted.gap_deviation**2
    # All three axes are admitted, and this is one of them.
    assert told_variance > (0.8 * shown) ** 2


def test_drift_grows_with_the_time_between_the_views_and_does_not_average_out() -> None:
    error = CalibrationError(NOTHING, 0.0, drift=1e-4)
    spreads = []
    for count, seconds in ((20, 1.0), (20, 2.0), (200, 2.0)):
        views = replace(scope(count), times=np.linspace(0.0, seconds, count))
        fitted = fit(views)
        wider = error.widened(fitted, views)
        spreads.append(np.sqrt(wider.gap_deviation**2 - fitted.gap_deviation**2))
    assert spreads[1] == pytest.approx(2.0 * spreads[0], rel=1e-3)
    assert spreads[2] > 0.8 * spreads[1]


def test_a_covariance_that_was_rounded_in_a_file_is_one() -> None:
    column = np.array([1e-4, -2e-4, 1.5e-4, 1e-3, 2e-3, -1e-3])
    rounded = np.array([[float(f"{number:.7g}") for number in row] for row in np.outer(column, column)])
    assert not reported("tracking_node", "a" * 64, error=rounded).flaw()


def test_another_error_under_the_same_hash_begins_a_new_track() -> None:
    estimator, views = GapEstimator(EXACT), scope(2, 0.0)
    assert views.lens_rotations is not None
    rotation = views.lens_rotations[0]
    bearings = views.bearings[0] @ rotation
    same = reported("tracking_node", "a" * 64, error=GOOD)
    estimator.add_calibration(same)
    counts = []
    for k, calibration in enumerate((same, replace(same), replace(same, lens_covariance=2.0 * GOOD))):
        estimator.add_calibration(calibration)
        stamp_ns = 10**18 + k * 10_000_000
        place = views.lens_positions[0] + [1e-3 * k, 0.0, 0.0]
        quaternion, covariance = Rotation.from_matrix(rotation).as_quat(), np.diag([1e-10] * 3 + [1e-9] * 3)
        estimator.add_pose(LensPose(stamp_ns, "world", place, quaternion, covariance), stamp_ns)
        edges = GapEdges.of_points(stamp_ns, 1, bearings, bearing_covariances(bearings, 2e-3), 6e-3)
        counts += [one.baseline for one in estimator.add_edges(edges, stamp_ns)]
    assert counts == pytest.approx([0.0, 1e-3, 0.0])


@pytest.mark.parametrize("error", [np.diag([1e-2] * 3 + [1.0] * 3), np.zeros((6, 6))])
@pytest.mark.parametrize("clock", [0.0, 1.0])
@pytest.mark.parametrize("turning", [0.0, 0.3])
def test_the_largest_error_that_is_taken_gives_statuses(error: Array, clock: float, turning: float) -> None:
    found = estimates(
        replace(reported("tracking_node", "a" * 64, error=error), time_offset_error=clock), turning=turning
    )
    assert len(found) == 40
    if clock or error.any():
        assert GapStatus.VALID not in {one.status for one in found}


def test_what_cannot_be_calculated_with_is_a_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("knee_gap_uncertainty.estimation.gap_track.explained_by", singular)
    found = estimates(reported("tracking_node", "a" * 64, error=GOOD))
    assert {one.status for one in found} == {GapStatus.UNKNOWN}
    assert "unusable numbers" in found[-1].reason


def test_an_image_whose_velocity_is_unknown_is_not_taken_where_the_clock_is_uncertain() -> None:
    """The first image lies at the only pose there is then."""
    uncertain = replace(reported("tracking_node", "a" * 64, error=GOOD), time_offset_error=1e-3)
    found = estimates(uncertain)
    assert found[0].status is GapStatus.OUT_OF_SYNC
    assert "speed at the image is unknown" in found[0].reason
    assert found[1].status is not GapStatus.OUT_OF_SYNC
    assert estimates(reported("tracking_node", "a" * 64, error=GOOD))[0].status is not GapStatus.OUT_OF_SYNC


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


def test_nodes_with_different_calibrations_contradict_each_other() -> None:
    one, other, none = (
        reported("tracking_node", "a" * 64),
        reported("segmentation_node", "b" * 64),
        reported("x", ""),
    )
    assert not contradiction({"tracking_node": one})
    assert not contradiction({"tracking_node": one, "segmentation_node": replace(other, hash="a" * 64)})
    words = contradiction({"tracking_node": one, "segmentation_node": other})
    assert "segmentation_node bbbbbbbbbbbb, tracking_node aaaaaaaaaaaa" in words
    assert "x none" in contradiction({"tracking_node": one, "x": none})


def test_nothing_is_valid_while_the_nodes_contradict_each_other() -> None:
    same = estimates(reported("tracking_node", "a" * 64), reported("segmentation_node", "a" * 64))
    assert any(estimate.status is GapStatus.VALID for estimate in same)
    different = estimates(reported("tracking_node", "a" * 64), reported("segmentation_node", ""))
    assert {estimate.status for estimate in different} == {GapStatus.UNKNOWN}
    assert "different calibrations" in different[-1].reason


def test_both_intervals_include_the_calibrations_error() -> None:
    without = estimates()[-1]
    poor = np.diag([1e-8] * 3 + [1e-5] * 3)
    with_it = estimates(reported("tracking_node", "a" * 64, error=poor))[-1]
    assert with_it.status is without.status is GapStatus.VALID
    assert with_it.gap == pytest.approx(without.gap)
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(with_it, low) < getattr(without, low)
        assert getattr(with_it, high) > getattr(without, high)


def test_both_intervals_include_the_cameras_error() -> None:
    exact = reported("tracking_node", "a" * 64, error=NOTHING)
    without, with_it = estimates(exact)[-1], estimates(exact, camera=3.0)[-1]
    assert with_it.status is without.status is GapStatus.VALID
    assert with_it.gap == pytest.approx(without.gap)
    assert with_it.shares[3] > without.shares[3]
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(with_it, low) < getattr(without, low)
        assert getattr(with_it, high) > getattr(without, high)


def test_both_intervals_include_a_cameras_error_without_a_calibration() -> None:
    """As of a camera_info whose angles were converted to another medium."""
    without, with_it = estimates()[-1], estimates(camera=3.0)[-1]
    assert with_it.status is without.status is GapStatus.VALID
    for low, high in (("gap_min", "gap_max"), ("confidence_min", "confidence_max")):
        assert getattr(with_it, low) < getattr(without, low)
        assert getattr(with_it, high) > getattr(without, high)


def test_errors_of_a_camera_that_are_none_give_no_estimate() -> None:
    wrong = estimates(reported("tracking_node", "a" * 64, error=NOTHING), camera=float("nan"))
    assert {estimate.status for estimate in wrong} == {GapStatus.NO_EDGES}
