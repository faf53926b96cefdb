"""Rotation of an oblique scope in its camera head at an image, from the rotations reported with its poses."""

from bisect import bisect_left
from collections import deque
from enum import StrEnum
from math import isfinite, pi, remainder
from typing import NamedTuple

KEPT = 512  # as long as poses of the lens may come late


class ScopeRotation(NamedTuple):
    """The turn [rad] of the scope since its calibration, at a stamp."""

    stamp_ns: int
    turn: float


class RotationRefusal(StrEnum):
    """Why a turn is not kept, or why there is none at a stamp."""

    NOT_FINITE = "the turn is NaN or infinite"
    TOO_LARGE = "the rotation exceeds one revolution: is it in radians?"
    NOT_YET = "no scope_rotation follows the stamp yet"
    NONE_NEAR = "no scope_rotation within max_pose_age of the image"


class ScopeRotations:
    """The latest turns, in the order of their stamps; between two they are interpolated, never beyond one.

    `max_age` [s] is the longest time between the stamp asked for and either of its two turns.
    """

    def __init__(self, max_age: float) -> None:
        self._turns: deque[ScopeRotation] = deque(maxlen=KEPT)
        self._age_ns = round(max_age * 1e9)

    def add(self, reported: ScopeRotation) -> RotationRefusal | None:
        """Add a rotation, or return why not; one before the last (a bag starts again) clears the rest."""
        if not isfinite(reported.turn):
            return RotationRefusal.NOT_FINITE
        if abs(reported.turn) > 2.0 * pi:
            return RotationRefusal.TOO_LARGE
        if self._turns and reported.stamp_ns < self._turns[-1].stamp_ns:
            self._turns.clear()
        if self._turns and reported.stamp_ns == self._turns[-1].stamp_ns:
            self._turns.pop()
        self._turns.append(reported)
        return None

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the turns before a stamp."""
        while self._turns and self._turns[0].stamp_ns < stamp_ns:
            self._turns.popleft()

    def at(self, stamp_ns: int) -> float | RotationRefusal:
        """Return the turn [rad] at a stamp, the shorter way round between two, or why there is none."""
        if not self._turns or stamp_ns > self._turns[-1].stamp_ns:
            return RotationRefusal.NOT_YET
        index = bisect_left(self._turns, stamp_ns, key=lambda reported: reported.stamp_ns)
        after = self._turns[index]
        if after.stamp_ns == stamp_ns:
            return after.turn
        if index == 0:
            return RotationRefusal.NONE_NEAR
        before = self._turns[index - 1]
        since, until = stamp_ns - before.stamp_ns, after.stamp_ns - stamp_ns
        if max(since, until) > self._age_ns:
            return RotationRefusal.NONE_NEAR
        return before.turn + since / (since + until) * remainder(after.turn - before.turn, 2.0 * pi)
