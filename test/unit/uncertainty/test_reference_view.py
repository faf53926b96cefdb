"""A scope that comes back keeps its baseline: bounds are made with the view that is farthest away."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tilted_scope import EXACT, TRUE_GAP, edges, pose, run

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.scope_calibration.posed_view import posed_view
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError

TURN = Rotation.from_euler("y", 10.0, degrees=True)

# There and back, as a hand goes.
PATH = [float(x) for x in 0.003 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 81)))]


def test_a_scope_that_comes_back_to_its_start_stays_valid() -> None:
    estimates = run(GapEstimator(EXACT), PATH)
    there, back = estimates[40], estimates[-1]
    assert there.status is back.status is GapStatus.VALID
    assert back.baseline == pytest.approx(0.006, abs=1e-6)
    assert back.gap_max - back.gap_min < 1.2 * (there.gap_max - there.gap_min)


def test_half_way_back_the_baseline_is_half_and_bounds_hold() -> None:
    estimates = run(GapEstimator(EXACT), PATH)
    assert estimates[60].baseline == pytest.approx(0.003, abs=1e-6)
    valid = [one for one in estimates if one.status is GapStatus.VALID]
    assert all(one.point_distance_min < TRUE_GAP < one.point_distance_max for one in valid)
    assert all(one.status is GapStatus.VALID for one in estimates[30:])


def test_a_swing_beyond_the_start_is_bounded_by_one_reference() -> None:
    """Each image's baseline, rule and bounds are of the same two views."""
    swing = [float(x) for x in -0.003 * np.sin(np.linspace(0.0, 2.0 * np.pi, 121))]
    estimates = run(GapEstimator(EXACT), swing)
    valid = [one for one in estimates if one.status is GapStatus.VALID]
    assert len(valid) > 60
    assert all(one.point_distance_min < TRUE_GAP < one.point_distance_max for one in valid)
    # Bounds are never narrower than the baseline of their image makes them.
    widths = np.array([one.gap_max - one.gap_min for one in valid])
    baselines = np.array([one.baseline for one in valid])
    assert np.corrcoef(widths, 1.0 / baselines)[0, 1] > 0.8


def test_creep_from_the_first_view_on_is_admitted_at_a_later_reference() -> None:
    """The lens creeps on a body that turns: late views differ by more than what it crept between them."""
    drift = CalibrationError(np.zeros((6, 6)), 0.0, drift=1e-4)
    late, present = (
        posed_view(edges(seconds * 10**9, 0.0), pose(seconds * 10**9, 0.0), 3.0) for seconds in (55, 60)
    )
    turned = present._replace(
        view=replace(present.view, lens_rotations=present.view.lens_rotations @ TURN.as_matrix())
    )
    same = drift.bounds(late, present, 1.0, begin_ns=0)[1]
    assert same == pytest.approx(drift.bounds(late, present, 1.0)[1]) == pytest.approx(0.5e-4 * 5.0)
    assert drift.bounds(late, turned, 1.0, begin_ns=0)[1] == pytest.approx(5.6e-4, rel=0.02)
