"""How long an image waits for its lens pose: while poses come for `max_pose_wait`, and no longer without."""

import math

import numpy as np
from tilted_scope import EXACT, FRAME_NS, MS, edges, pose, run

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator


def test_image_waits_for_the_pose_after_it_and_is_never_extrapolated() -> None:
    estimator = GapEstimator(EXACT)
    estimator.add_pose(pose(10**9 - MS, 0.0), 10**9)
    assert estimator.add_edges(edges(10**9, 0.0), 10**9) == []
    assert estimator.advance(10**9 + 15 * MS) == []
    (estimate,) = estimator.add_pose(pose(10**9 + MS, 0.0), 10**9 + 16 * MS)
    assert estimate.status is GapStatus.INSUFFICIENT_PARALLAX


def test_tracking_lost_within_the_wait_and_said_once_an_image() -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, list(np.linspace(0.0, 0.006, 30)))
    stamp = 10**9 + 30 * FRAME_NS
    assert estimator.add_edges(edges(stamp, 0.006), stamp) == []
    (estimate,) = estimator.advance(stamp + 21 * MS)
    assert estimate.status is GapStatus.TRACKING_LOST
    assert math.isnan(estimate.gap)
    assert math.isnan(estimate.gap_min)
    assert estimator.advance(stamp + 22 * MS) == []


def after_poses_ended() -> tuple[GapEstimator, int]:
    """An estimator 40 ms after its last pose, and the stamp of an image of 10 ms ago [ns]."""
    estimator = GapEstimator(EXACT)
    run(estimator, list(np.linspace(0.0, 0.006, 30)))
    return estimator, 10**9 + 29 * FRAME_NS + 30 * MS


def test_poses_that_have_ended_are_not_awaited() -> None:
    estimator, stamp = after_poses_ended()
    (estimate,) = estimator.add_edges(edges(stamp, 0.006), stamp + 10 * MS)
    assert estimate.status is GapStatus.TRACKING_LOST


def test_edges_that_lay_in_a_queue_let_the_poses_in_their_queue_come_first() -> None:
    estimator, stamp = after_poses_ended()
    now = stamp + 10 * MS
    assert estimator.add_edges(edges(stamp, 0.006), now, queued_ns=9 * MS) == []
    assert estimator.add_pose(pose(stamp - MS, 0.006 + 1e-6), now + MS, queued_ns=9 * MS) == []
    (estimate,) = estimator.add_pose(pose(stamp + MS, 0.006 + 2e-6), now + MS, queued_ns=9 * MS)
    assert estimate.status is GapStatus.VALID


def test_without_poses_in_a_queue_they_wait_no_longer() -> None:
    estimator, stamp = after_poses_ended()
    now = stamp + 10 * MS
    assert estimator.add_edges(edges(stamp, 0.006), now, queued_ns=9 * MS) == []
    (estimate,) = estimator.advance(now + 5 * MS)
    assert estimate.status is GapStatus.TRACKING_LOST


def test_poses_of_a_clock_that_was_set_back_are_awaited() -> None:
    estimator, _ = after_poses_ended()
    begin = 10**9 - 10**8
    estimator.add_pose(pose(begin - MS, 0.0), begin)
    assert estimator.add_edges(edges(begin, 0.0), begin + MS) == []
    (estimate,) = estimator.add_pose(pose(begin + MS, 1e-6), begin + 2 * MS)
    assert estimate.status is GapStatus.INSUFFICIENT_PARALLAX
