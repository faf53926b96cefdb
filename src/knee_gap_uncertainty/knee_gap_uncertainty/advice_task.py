"""Advice made beside the estimates: a few pieces at a time, so that no image waits for it."""

from collections.abc import Generator

import numpy as np

from knee_gap_uncertainty.motion_advice import AdviceParameters, MotionAdvice, MotionAdvisor, Situation

# Pieces a turn, each of about a millisecond: at 100 turns a second five pieces of advice are made in one.
PIECES = 4
# Advice is for a hand or a robot that carries a scope: ten times a second is as often as it can be followed.
PERIOD_NS = 100_000_000


class AdviceTask:
    """Takes up the latest situation whenever it has done with the one before."""

    def __init__(self, parameters: AdviceParameters | None = None) -> None:
        self.parameters = parameters or AdviceParameters()
        self._advisor = MotionAdvisor(self.parameters)
        self._pieces: Generator[MotionAdvice | None, None, None] | None = None
        self._begun: Situation | None = None
        self._done: tuple[Situation, MotionAdvice] | None = None

    def turn(self, latest: Situation | None) -> MotionAdvice | None:
        """Do a few pieces of work; return the advice when it is complete.

        `latest` is None where nothing can be advised; work on a track that has ended is dropped.
        """
        if latest is None or (self._begun is not None and self._begun.track_id != latest.track_id):
            self._pieces = self._begun = self._done = None
        if latest is None:
            return None
        if self._pieces is None:
            if self._done is not None and latest.stamp_ns - self._done[0].stamp_ns < PERIOD_NS:
                return None
            self._begun, self._pieces = latest, self._advisor.in_pieces(latest)
        for _ in range(PIECES):
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
