"""When messages have been missing for too long: longer than their own interval and a margin."""

from collections import deque
from statistics import median

from knee_gap_core.values.stamps import NANOSECONDS

# Intervals between messages from which the usual one is found.
INTERVALS = 9
# Longest interval that counts as usual [s], and the usual one before two messages have come. A silence must
# be reported before a subscriber's deadline of 0.1 s, give or take a tick.
LONGEST_INTERVAL = 0.07


class Silence:
    """Watches for missing messages; repeated silence is reported every `margin`.

    `margin` [s]: how much longer than the usual interval between messages one may be missing.
    """

    def __init__(self, margin: float) -> None:
        self._margin_ns = round(margin * NANOSECONDS)
        self._intervals: deque[int] = deque(maxlen=INTERVALS)
        # A recording played slowly: its messages arrive farther apart than they are stamped.
        self._arrivals: deque[int] = deque(maxlen=INTERVALS)
        self._last_stamp_ns: int | None = None
        self._last_arrival_ns = 0
        self._due_ns = 0

    def add(self, stamp_ns: int, now_ns: int) -> None:
        """Receive a message's stamp [ns]; stamps that ran backwards begin again."""
        if self._last_stamp_ns is not None:
            if stamp_ns > self._last_stamp_ns:
                self._intervals.append(stamp_ns - self._last_stamp_ns)
                self._arrivals.append(now_ns - self._last_arrival_ns)
            else:
                self._intervals.clear()
                self._arrivals.clear()
        self._last_stamp_ns, self._last_arrival_ns = stamp_ns, now_ns
        self.restart(now_ns)

    def restart(self, now_ns: int) -> None:
        """Wait from now [ns] for the next message, as after one."""
        self._due_ns = now_ns + self._usual_ns() + self._margin_ns

    def report(self, now_ns: int) -> None:
        """Note that silence has just been reported."""
        self._due_ns = now_ns + self._margin_ns

    def is_due(self, now_ns: int) -> bool:
        """Whether silence must be reported at this time [ns]."""
        return now_ns > self._due_ns

    def _usual_ns(self) -> int:
        longest = round(LONGEST_INTERVAL * NANOSECONDS)
        if not self._intervals:
            return longest
        return min(max(round(median(self._intervals)), round(median(self._arrivals))), longest)
