"""Advice made beside the estimates: a few pieces at a time, so that no image waits for it."""

from collections.abc import Generator

import numpy as np

from knee_gap_uncertainty.motion_advice.motion_advice import (
    AdviceParameters,
    MotionAdvice,
    MotionAdvisor,
    Situation,
)

# Pieces a turn, each of a fraction of a millisecond: at 50 turns a second advice takes a fifth of a second.
PIECES = 8
# How much longer than it took the advice rests, where it took long.
REST = 4
# Advice is for a hand or a robot that carries a scope: five times a second is as often as it can be followed.
PERIOD_NS = 200_000_000


class AdvicePace:
    """How many pieces of advice the next turn of a live node may do, by what the last ones took.

    Most pieces take a fraction of a millisecond, but where two clouds are wide beside their distance one may
    take twenty: then one at a time, with rests between, so that images are answered in time.
    """

    def __init__(self, period: float) -> None:
        """`period` [s] between turns."""
        self._period = period
        self._rest = 0
        self._resting = False
        self._pieces = PIECES

    def next(self) -> int:
        """Pieces of this turn; 0 while it is to rest."""
        self._resting = self._rest > 0
        if self._resting:
            self._rest -= 1
            return 0
        return self._pieces

    def spent(self, seconds: float) -> None:
        """Note what the turn took [s]."""
        if self._resting:
            return
        if seconds > self._period / 2:
            self._pieces, self._rest = 1, int(REST * seconds / self._period)
        else:
            self._pieces = min(PIECES, self._pieces + 1)


class AdviceTask:
    """Takes up the latest situation whenever it has done with the one before."""

    def __init__(self, parameters: AdviceParameters | None = None) -> None:
        self.parameters = parameters or AdviceParameters()
        self._advisor = MotionAdvisor(self.parameters)
        self._pieces: Generator[MotionAdvice | None, None, None] | None = None
        self._begun: Situation | None = None
        self._done: tuple[Situation, MotionAdvice] | None = None

    def turn(self, latest: Situation | None, pieces: int = PIECES) -> MotionAdvice | None:
        """Do a few pieces of work; return the advice when it is complete.

        `latest` is None if nothing can be advised; work on a track that has ended is dropped.
        """
        if latest is None or (self._begun is not None and self._begun.track_id != latest.track_id):
            self._pieces = self._begun = self._done = None
        if latest is None:
            return None
        if self._pieces is None:
            if self._done is not None and latest.stamp_ns - self._done[0].stamp_ns < PERIOD_NS:
                return None
            self._begun, self._pieces = latest, self._advisor.in_pieces(latest)
        for _ in range(pieces):
            advice = next(self._pieces)
            if advice is not None:
                assert self._begun is not None
                self._done, self._pieces = (self._begun, advice), None
                return advice
        return None

    def travel_left(self, now: Situation | None) -> float:
        """Travel along the present direction [m] that is left of what was advised; NaN if not known."""
        if now is None or self._done is None or self._done[0].track_id != now.track_id:
            return float("nan")
        then, advice = self._done
        if not advice.present.reachable:
            return float("nan")
        done = float((now.lens - then.lens) @ then.direction)
        return max(0.0, advice.present.travel - done) if np.isfinite(done) else advice.present.travel
