"""A scope that comes back keeps its baseline: bounds are made with the view that is farthest away."""

import numpy as np
import pytest
from tilted_scope import EXACT, FRAME_NS, MS, TRAVEL, TRUE_GAP, edges, pose, run

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator

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


def test_a_view_that_contradicts_the_track_is_no_reference() -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, TRAVEL)
    stamp = 10**9 + len(TRAVEL) * FRAME_NS
    # The points have moved by 2 mm, as if the lens were elsewhere.
    estimator.add_pose(pose(stamp - MS, 0.0065), stamp)
    estimator.add_edges(edges(stamp, 0.0045), stamp)
    (moved,) = estimator.add_pose(pose(stamp + MS, 0.0065), stamp)
    assert moved.status is not GapStatus.VALID
    (after,) = run(estimator, [0.006], begin=stamp + FRAME_NS)
    assert after.status is not GapStatus.VALID or after.baseline == pytest.approx(0.006, abs=1e-5)
    assert not np.isfinite(after.gap_min) or after.gap_min < TRUE_GAP
