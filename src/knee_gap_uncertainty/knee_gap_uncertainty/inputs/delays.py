"""Clocks and delays of a live node: how late a message is, and how time goes on when its clock stops."""

from collections import deque

from knee_gap_core.values.stamps import NANOSECONDS

# Of a replay, whose stamps may fall behind the clock slowly: a quarter of a second of a tracker.
POSES_OF_REPLAY = 32
# Over so many seconds the least delay is what a message needs: a node that was stopped, or a machine that is
# starved, makes all messages late alike, but not those of before.
SECONDS_OF_LIVE = 10
# The clock of a bag comes in ticks: so many of the longest recent one must be missing before it stands still.
MISSING_TICKS = 3
TICKS_KEPT = 32
LEAST_PATIENCE_NS = 50_000_000


class DelayFloor:
    """The least time by which the clock was ahead of the stamps of recent lens poses."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=POSES_OF_REPLAY)
        self._by_second: deque[tuple[int, int]] = deque(maxlen=SECONDS_OF_LIVE)
        self._is_live = False

    def clear(self) -> None:
        """Forget all delays, as when the clock or the stamps ran backwards."""
        self._recent.clear()
        self._by_second.clear()

    def take(self, delay_ns: int, arrival_ns: int, *, is_live: bool) -> None:
        """Take the delay of a pose; `is_live`: its stamp is of the clock's own time, not of a recording."""
        if is_live != self._is_live:
            self.clear()
            self._is_live = is_live
        self._recent.append(delay_ns)
        second = arrival_ns // NANOSECONDS
        if self._by_second and self._by_second[-1][0] == second:
            delay_ns = min(delay_ns, self._by_second.pop()[1])
        self._by_second.append((second, delay_ns))

    def excess(self, delay_ns: int) -> float:
        """How much longer than the least a delay is [s]; 0 while no pose came."""
        if not self._recent:
            return 0.0
        least = min(delay for _, delay in self._by_second) if self._is_live else min(self._recent)
        return (delay_ns - least) / NANOSECONDS


class ContinuedClock:
    """A clock that goes on by the steady one when the node's clock stands still, as /clock may."""

    def __init__(self) -> None:
        self._clock_ns = -1
        self._changed_ns = 0
        self._ticks: deque[int] = deque(maxlen=TICKS_KEPT)

    def read(self, clock_ns: int, steady_ns: int) -> int:
        """The node's clock, or what it would show by now had it not stopped [ns]."""
        if clock_ns != self._clock_ns:
            if self._clock_ns >= 0:
                self._ticks.append(steady_ns - self._changed_ns)
            self._clock_ns, self._changed_ns = clock_ns, steady_ns
            return clock_ns
        patience = max(LEAST_PATIENCE_NS, MISSING_TICKS * max(self._ticks, default=0))
        return clock_ns + max(0, steady_ns - self._changed_ns - patience)
