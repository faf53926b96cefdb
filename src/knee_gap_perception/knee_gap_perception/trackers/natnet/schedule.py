"""Times of a NatNet session: when its requests are due, and after which silence the server is lost."""

from dataclasses import dataclass

from knee_gap_core.values.stamps import NANOSECONDS

FIRST_RETRY_NS = NANOSECONDS // 4
LAST_RETRY_NS = 4 * NANOSECONDS
ECHO_NS = NANOSECONDS // 2
# The first echoes follow each other closely, so that stamps are available soon, and more of them while the
# clock's error is large.
FIRST_ECHOES = 8
MOST_FIRST_ECHOES = 60
FINE_CLOCK_NS = 100_000
FIRST_ECHO_NS = 20_000_000
KEEP_ALIVE_NS = NANOSECONDS // 2
MODELS_NS = 2 * NANOSECONDS
# Time without a packet after which the server is lost, and time without a frame after which data are missing.
GONE_NS = 2 * NANOSECONDS
NO_DATA_NS = NANOSECONDS


@dataclass
class Due:
    """Next time at which a request is due [ns], and the interval to the one after."""

    at_ns: int = 0
    every_ns: int = 0

    def take(self, now_ns: int) -> bool:
        """Whether the request is due; if so, it is postponed by its interval."""
        if now_ns < self.at_ns:
            return False
        self.at_ns = now_ns + self.every_ns
        return True
