"""Clocks that stop and nodes that were stopped: how late an answer is, and silence by the steady clock."""

from dataclasses import replace

import numpy as np
from travelling_scope import TINY, travelling

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.inputs.delays import ContinuedClock, DelayFloor

MS = 1_000_000
SECOND = 1_000_000_000


def test_a_clock_that_runs_is_read_as_it_is() -> None:
    clock = ContinuedClock()
    for k in range(100):
        assert clock.read(10**18 + 10 * MS * k, 5 * SECOND + 10 * MS * k) == 10**18 + 10 * MS * k


def test_a_clock_that_stops_goes_on_after_a_few_ticks() -> None:
    clock = ContinuedClock()
    for k in range(100):
        clock.read(10 * MS * k, 10 * MS * k)
    last = 990 * MS
    assert clock.read(last, last + 40 * MS) == last
    assert clock.read(last, last + 550 * MS) == last + 500 * MS


def test_a_slow_clock_does_not_stand_still_between_its_ticks() -> None:
    """A bag at a tenth of its rate: a tick each 100 ms, looked at each 10 ms."""
    clock = ContinuedClock()
    for k in range(300):
        read = clock.read(10 * MS * (k // 10), 10 * MS * k)
        # The first tick shows how long they take.
        assert read == 10 * MS * (k // 10) or k < 10
    assert clock.read(290 * MS, 3000 * MS) == 290 * MS


def test_live_an_answer_is_held_to_the_least_delay_of_ten_seconds() -> None:
    floor = DelayFloor()
    for k in range(1200):
        floor.take(3 * MS + (k % 7) * MS, k * SECOND // 120, is_live=True)
    # All late alike, as after a stop of this node.
    for k in range(1200, 1300):
        floor.take(900 * MS, k * SECOND // 120, is_live=True)
    assert floor.excess(900 * MS) > 0.85
    assert floor.excess(3 * MS) == 0.0


def test_of_a_recording_stamps_may_fall_behind_slowly() -> None:
    floor = DelayFloor()
    for k in range(1200):
        floor.take(k * 4 * MS, k * SECOND // 120, is_live=False)
    assert floor.excess(1200 * 4 * MS) < 0.2


def test_an_estimate_that_leaves_late_is_not_valid() -> None:
    estimator = GapEstimator(TINY)
    estimator.begin(10**9)
    last = travelling(estimator, 0.010, 0.004)[-1]
    assert last.status is GapStatus.VALID
    assert estimator.leaving(last, last.stamp_ns + 100 * MS) is last
    late = estimator.leaving(last, last.stamp_ns + 600 * MS)
    assert late.status is GapStatus.OUT_OF_SYNC
    assert np.isnan(late.gap)
    assert estimator.leaving(replace(last, status=GapStatus.UNKNOWN), 10**12).status is GapStatus.UNKNOWN


def test_silence_is_reported_from_the_start_of_a_live_node() -> None:
    estimator = GapEstimator(TINY)
    assert estimator.advance(10**9) == []
    (begin,) = estimator.begin(10**9)
    assert begin.status is GapStatus.UNKNOWN
    assert estimator.advance(10**9 + 20 * MS) == []
    (still,) = estimator.advance(10**9 + 60 * MS)
    assert still.status is GapStatus.UNKNOWN
    assert still.stamp_ns == 10**9 + 60 * MS
