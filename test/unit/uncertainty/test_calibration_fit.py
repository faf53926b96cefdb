"""What a wrong calibration does to the views of a track is distinguished from a joint that moves."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.scope_calibration.calibration_fit import explained_by
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError
from knee_gap_uncertainty.studies.wrong_calibration.simulated_scope import (
    POINTS,
    SIGMA,
    Hand,
    stated,
    wrong_scope,
)

LARGE = (2e-3, np.radians(1.5), 3e-3)


def test_a_wrong_calibration_with_a_stated_error_is_no_motion() -> None:
    gap = float(np.linalg.norm(POINTS[1] - POINTS[0]))
    for seed in range(6):
        reported = wrong_scope(seed, *LARGE)
        assert GapStatus.JOINT_MOVED not in {one.status for one in reported}
        valid = [one for one in reported if one.status is GapStatus.VALID]
        assert all(one.gap_min < gap < one.gap_max for one in valid)


@pytest.mark.parametrize("scope", [(2e-5, np.radians(0.015), 4e-5), (3e-4, np.radians(0.2), 1e-3)])
def test_a_joint_that_moves_is_still_found(scope: tuple[float, float, float]) -> None:
    across = np.array([0.0, 0.002, 0.0])
    for seed in range(4):
        reported = [one.status for one in wrong_scope(seed, *scope, moved=across)]
        assert GapStatus.JOINT_MOVED in reported[75:]
        assert GapStatus.JOINT_MOVED not in reported[:75]


@pytest.mark.parametrize("axis", range(7))
def test_without_noise_nothing_is_left_of_the_error(axis: int) -> None:
    """The views less the error fit points at rest, which as they come they do not."""
    size = np.array([2e-3] * 3 + [np.radians(2.0)] * 3 + [8e-3])
    wrong = np.zeros(7)
    wrong[axis] = size[axis]
    views = Hand(np.random.default_rng(axis), wrong).views()
    error = CalibrationError(np.diag(size[:6] ** 2), float(size[6]))
    shared = explained_by(error, views)
    assert shared is not None
    before, after = residual(views), residual(shared.taken_from(views))
    assert after < 0.1 * SIGMA
    assert after < 0.35 * before or before < 0.1 * SIGMA


def test_a_picture_that_turns_on_the_sensor_changes_nothing() -> None:
    """What the lens's error does is the same, whichever way the picture is turned by the scope."""
    views = Hand(np.random.default_rng(3), np.array([1e-3, -2e-3, 1e-3, 0.02, 0.01, -0.03, 4e-3])).views()
    turns = np.linspace(-1.0, 2.0, len(views))
    back = Rotation.from_rotvec(np.outer(-turns, [0.0, 0.0, 1.0])).as_matrix()
    assert views.lens_rotations is not None
    turned = replace(views, lens_rotations=views.lens_rotations @ back, scope_rotations=turns)
    error = CalibrationError(stated(*LARGE[:2]), LARGE[2])
    one, other = explained_by(error, views), explained_by(error, turned)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other.parts, one.parts, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        other.taken_from(turned).lens_positions, one.taken_from(views).lens_positions, atol=1e-9
    )


def test_a_clock_taken_from_a_view_brings_the_noise_of_its_velocity() -> None:
    """At x(t) - late v with v = (x(t) - x(t - T)) / T: late / T times two poses' errors come in."""
    views = Hand(np.random.default_rng(4), np.zeros(7)).views()
    timed = replace(views, motion_times=np.full(len(views), 0.02))
    shared = explained_by(CalibrationError(stated(*LARGE[:2]), LARGE[2]), views)
    assert shared is not None
    late = shared._replace(parts=np.array([0, 0, 0, 0, 0, 0, 0.01]))
    for name in ("lens_covariances", "rotation_covariances"):
        np.testing.assert_allclose(getattr(late.taken_from(timed), name), 1.5 * getattr(views, name))
        np.testing.assert_allclose(getattr(late.taken_from(views), name), getattr(views, name))


def residual(views: Views) -> float:
    """RMS angle [rad] by which the views miss the points that suit them best."""
    points = fit(replace(views, common_share=0.0)).points
    towards = points - views.lens_positions[:, None]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum((towards - views.bearings) ** 2, axis=-1))))


def test_an_error_far_below_the_noise_is_left_alone() -> None:
    views = Hand(np.random.default_rng(2), np.zeros(7)).views()
    assert explained_by(CalibrationError(stated(2e-5, np.radians(0.01)), 3e-5), views) is None
    assert explained_by(CalibrationError(stated(*LARGE[:2]), LARGE[2]), views) is not None
    assert (
        explained_by(CalibrationError(stated(*LARGE[:2]), LARGE[2]), replace(views, lens_rotations=None))
        is None
    )
