"""The rules by which an estimate is rejected: what VALID promises, and what is counted of the rest."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from travelling_scope import TINY, travelling

from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.acceptance import RULES, Facts, Kept, Reason, judge
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.multi_view.views import bearing_covariances

FRAME_NS = 16_666_667


@pytest.mark.parametrize("depth", [0.005, 0.010, 0.020, 0.040])
def test_nothing_is_valid_before_the_scope_has_moved_a_tenth_of_the_distance(depth: float) -> None:
    """README: 1 mm at 10 mm; the farther point counts, and however small all errors are."""
    found = travelling(GapEstimator(TINY), depth, 0.2 * depth)
    farther = math.hypot(depth, 0.002)
    valid = [one for one in found if one.status is GapStatus.VALID]
    assert valid
    assert min(one.baseline for one in valid) >= max(0.1 * farther, 0.5e-3)
    short = [one for one in found if one.baseline < 0.099 * farther]
    assert short
    assert {one.status for one in short} == {GapStatus.INSUFFICIENT_PARALLAX}
    assert all(math.isnan(one.gap) and not one.gap_max < math.inf for one in short)


def test_bounds_beyond_any_joint_are_not_valid() -> None:
    """largest_gap holds for what the errors admit, not for the estimate alone."""
    wide = travelling(GapEstimator(TINY), 0.010, 0.004, sigma=0.015)
    assert not [one for one in wide if one.status is GapStatus.VALID and one.gap_max > 0.03]
    strict = replace(TINY, largest_gap=0.0041)
    narrow = travelling(GapEstimator(strict), 0.010, 0.004, sigma=1e-3)
    assert not [one for one in narrow if one.status is GapStatus.VALID and one.gap_max > 0.0041]
    rejected = [one for one in narrow if one.rejection and one.rejection.reason is Reason.BOUND_TOO_LARGE]
    assert rejected
    assert all(0.0 < one.gap_min < 0.004 and one.gap_max == math.inf for one in rejected)


def test_each_reason_has_one_rule_and_nothing_is_broken_by_nothing_known() -> None:
    assert sorted(rule.reason for rule in RULES) == sorted(Reason)
    assert GapStatus.VALID not in {rule.status for rule in RULES}
    assert judge(Facts(TINY)) is None
    assert all(rule.kept is Kept.NOTHING for rule in RULES if rule.status is GapStatus.UNKNOWN)


@pytest.mark.parametrize(("gap", "kept"), [(0.004, Kept.LOWER_BOUNDS), (0.002, Kept.NOTHING)])
def test_no_lower_bound_is_kept_that_the_estimate_contradicts(gap: float, kept: Kept) -> None:
    """An earlier rule with lower bounds does not hide that the numbers contradict each other."""
    measured = GapEstimate(
        1, "world", GapStatus.VALID, gap=gap, gap_min=0.003, gap_max=0.005, baseline=1.0,
        point_distance=0.004, point_distance_min=0.003, point_distance_max=0.005,
    )  # fmt: skip
    verdict = judge(Facts(TINY, at_border=True, measured=measured, still_count=9))
    assert verdict is not None
    assert (verdict.rejection.reason, verdict.kept) == (Reason.AT_BORDER, kept)


def test_counts_stay_bounded_whatever_is_wrong_with_edges_and_poses() -> None:
    rng = np.random.default_rng(4)
    estimator = GapEstimator(TINY)
    for k in range(300):
        stamp = 10**9 + k * FRAME_NS
        bearings = rng.standard_normal((2, 3)) * rng.choice([1.0, 1e-3, np.nan])
        if rng.random() < 0.7:
            bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        covariances = bearing_covariances(bearings, rng.choice([1e-3, 10.0]))
        bound = rng.choice([-1.0, 1e-6, 0.1, 9.0])
        status = EdgeStatus.VALID if rng.random() < 0.9 else EdgeStatus(k % len(EdgeStatus))
        edges = replace(GapEdges.of_points(stamp, 1, bearings, covariances, bound), status=status)
        place = 1e-4 * rng.standard_normal(3)
        quaternion = Rotation.random(random_state=k).as_quat()
        estimator.add_pose(LensPose(stamp, "world", place, quaternion, np.diag([1e-12] * 6)), stamp)
        estimator.add_edges(edges, stamp)
        estimator.advance(stamp + FRAME_NS)
    allowed = {f"{rule.status.name}: {rule.reason.value}" for rule in RULES}
    said = {key for key in estimator.counts if key.split(":")[0] in GapStatus.__members__ and ":" in key}
    assert said <= allowed
    assert len(estimator.counts) < len(RULES) + 20
    assert not any(character.isdigit() for key in estimator.counts for character in key)


@pytest.mark.parametrize("offset", [3600.0, -3600.0, 11.0, -11.0])
def test_a_stamp_far_from_the_clock_is_out_of_sync_live(offset: float) -> None:
    facts = Facts(TINY, clock_offset=offset)
    verdict = judge(facts)
    assert verdict is not None
    assert verdict.status is GapStatus.OUT_OF_SYNC
    assert verdict.rejection.reason is Reason.FAR_FROM_CLOCK


@pytest.mark.parametrize("offset", [0.0, 1.0, -0.1, math.nan, 3e7])
def test_a_stamp_of_the_clocks_time_or_of_a_recording_is_not(offset: float) -> None:
    assert judge(Facts(TINY, clock_offset=offset)) is None
