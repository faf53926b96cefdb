"""How far an oblique scope was turned in its camera head at an image, from what was told beside its poses."""

from collections import deque
from math import isfinite
from typing import NamedTuple

KEPT = 512  # as long as poses of the lens may come late


class ScopeTurn(NamedTuple):
    """The turn [rad] of the scope since its calibration, at a stamp."""

    stamp_ns: int
    turn: float


class ScopeTurns:
    """The latest turns, in the order of their stamps."""

    def __init__(self) -> None:
        self._turns: deque[ScopeTurn] = deque(maxlen=KEPT)

    def add(self, told: ScopeTurn) -> None:
        """Take a turn; one before the last (a bag that starts again) begins anew, one not finite is left."""
        if not isfinite(told.turn):
            return
        if self._turns and told.stamp_ns < self._turns[-1].stamp_ns:
            self._turns.clear()
        self._turns.append(told)

    def at(self, stamp_ns: int) -> float:
        """The turn [rad] told nearest to a stamp: 0 where none ever was, as nobody follows it then."""
        if not self._turns:
            return 0.0
        return min(reversed(self._turns), key=lambda told: abs(told.stamp_ns - stamp_ns)).turn
