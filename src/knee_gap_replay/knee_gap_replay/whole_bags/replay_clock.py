"""The clock by which the stamps of a bag were recorded: that of the drivers, or, in a replay, a later one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.int64]
# Recorded so much later or earlier than stamped [ns], a topic was not recorded as it was made.
OTHER_CLOCK_NS = 3_600 * 1_000_000_000
# A pace nearer to 1 than this is that of a live recording.
_PACE_TOLERANCE = 0.005
_ENOUGH_MESSAGES = 20


class ReplayClock(NamedTuple):
    """When a message with a stamp was played [ns]: `pace * (stamp - start) + record`."""

    start_ns: int
    record_ns: int
    pace: float

    def latency_ns(self, record_ns: Times, stamp_ns: Times) -> "npt.NDArray[np.float64]":
        """Return the time from playing to recording of each message."""
        return (record_ns - self.record_ns) - self.pace * (stamp_ns - self.start_ns)

    @property
    def words(self) -> str:
        """The clock in words."""
        rate = f" at {1.0 / self.pace:.2g} times its rate" if self.pace != 1.0 else ""
        return f"replayed{rate}"


def replay_clock(topics: Sequence[tuple[Times, Times]]) -> ReplayClock | None:
    """Return the clock of a replay from the recording times and stamps of its topics; None if it is live.

    The message that took the shortest time is taken to have taken none. All `topics` are of one clock.
    """
    if not topics:
        return None
    record_ns, stamp_ns = max(topics, key=lambda pair: pair[0].size)
    start_ns = int(stamp_ns[0])
    pace = 1.0
    if stamp_ns.size >= _ENOUGH_MESSAGES:
        steps, played = np.diff(stamp_ns), np.diff(record_ns)
        forward = steps > 0  # a loop steps back
        if forward.any():
            measured = float(played[forward].sum() / steps[forward].sum())
            pace = measured if abs(measured - 1.0) > _PACE_TOLERANCE else 1.0
    clock = ReplayClock(start_ns, 0, pace)
    least = min(float(clock.latency_ns(records, stamps).min()) for records, stamps in topics)
    return clock._replace(record_ns=round(least))
