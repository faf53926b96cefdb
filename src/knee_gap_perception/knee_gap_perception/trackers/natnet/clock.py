"""Clock synchronisation with a NatNet server: offset and rate of its ticks from echoes."""

from collections import deque
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.stamps import NANOSECONDS

# Largest relative rate difference of two crystals; 0.6 ms over the time after which the rate is fitted [ns].
MAX_DRIFT = 2e-4
RATE_KNOWN_AFTER_NS = 3 * NANOSECONDS
# Time without an echo after which the clock is not used any more [ns].
MAX_AGE_NS = 60 * NANOSECONDS
# Least number of echoes: among fewer, there may be no quick one.
FEWEST_ECHOES = 6
# An echo outside the clock's bounds by more than this belongs to another clock and is rejected [ns].
OTHER_CLOCK_NS = 2_000_000
# Number of rejected echoes in a row, in agreement with each other, that may mean a restart of the server.
FEWEST_OF_ANOTHER = 3


class Echo(NamedTuple):
    """Server ticks read at `local_ns`, with the error bound `error_ns`: half the duration of the echo."""

    ticks: int
    local_ns: int
    error_ns: float


class EchoClock:
    """Maps ticks of the server's clock to the local monotonic clock [ns].

    Each echo bounds the time at which the server read its clock. Echoes that took little longer than the
    quickest one are kept; a straight line through their midpoints gives offset and rate. An echo that
    contradicts the clock is rejected; `restart` adopts the clock of a server that restarted.
    """

    def __init__(self, frequency: int, max_error_ns: float = 1_000_000) -> None:
        self.frequency = frequency
        self.max_error_ns = max_error_ns
        self.restart_count = 0
        self._echoes: deque[Echo] = deque(maxlen=120)
        # Echoes rejected since the last accepted one.
        self._refused: list[Echo] = []
        self._origin: Echo | None = None
        self._ns_per_tick = NANOSECONDS / frequency
        self._error_ns = float("inf")

    @property
    def error_ns(self) -> float:
        """Error bound of the offset [ns]: half the duration of the quickest echo; infinite before any."""
        return self._error_ns

    def ready(self, now_ns: int) -> bool:
        """Whether ticks can be mapped to within `max_error_ns`, by enough echoes with a recent last one."""
        enough = len(self._echoes) >= FEWEST_ECHOES and self._error_ns <= self.max_error_ns
        return enough and now_ns - self._echoes[-1].local_ns <= MAX_AGE_NS

    @property
    def in_doubt(self) -> bool:
        """Whether the last echo contradicted the clock."""
        return bool(self._refused)

    @property
    def another(self) -> bool:
        """Whether the rejected echoes agree on another clock."""
        return len(self._refused) >= FEWEST_OF_ANOTHER

    def add(self, sent_ns: int, received_ns: int, ticks: int) -> bool:
        """Add an echo that was sent and received at these local times; return whether it was accepted."""
        if received_ns < sent_ns:
            return False
        echo = Echo(ticks, (sent_ns + received_ns) // 2, (received_ns - sent_ns) / 2)
        if self._origin is not None:
            off = abs(self.local_ns(ticks) - echo.local_ns)
            if off > echo.error_ns + self._error_ns + OTHER_CLOCK_NS:
                self._refuse(echo)
                return False
        self._refused.clear()
        self._echoes.append(echo)
        self._fit()
        return True

    def restart(self) -> None:
        """Adopt the clock of the rejected echoes."""
        self.restart_count += 1
        self._ns_per_tick = NANOSECONDS / self.frequency
        self._echoes.clear()
        self._echoes.extend(self._refused)
        self._refused.clear()
        self._fit()

    def _refuse(self, echo: Echo) -> None:
        if self._refused:
            first = self._refused[0]
            expected = first.local_ns + (echo.ticks - first.ticks) * NANOSECONDS / self.frequency
            if abs(expected - echo.local_ns) > first.error_ns + echo.error_ns + OTHER_CLOCK_NS:
                self._refused.clear()
        # As many as a ready clock needs.
        self._refused = [*self._refused, echo][-FEWEST_ECHOES:]

    def local_ns(self, ticks: int) -> int:
        """Local time of a tick. It needs `ready`, or at least one echo."""
        assert self._origin is not None
        return self._origin.local_ns + round((ticks - self._origin.ticks) * self._ns_per_tick)

    def _fit(self) -> None:
        latest = self._echoes[-1].local_ns
        best = min(self._echoes, key=lambda echo: echo.error_ns)
        # An echo that took longer was delayed on one of its two ways, which shifts its midpoint.
        quick = [echo for echo in self._echoes if echo.error_ns <= 1.5 * best.error_ns + 20_000]
        if quick[-1].local_ns - quick[0].local_ns < RATE_KNOWN_AFTER_NS:
            recent = [echo for echo in self._echoes if latest - echo.local_ns < RATE_KNOWN_AFTER_NS]
            self._origin = min(recent, key=lambda echo: echo.error_ns)
            self._error_ns = self._origin.error_ns
            return
        newest, nominal = quick[-1], NANOSECONDS / self.frequency
        ticks = np.array([echo.ticks - newest.ticks for echo in quick], dtype=np.float64)
        local = np.array([echo.local_ns - newest.local_ns for echo in quick], dtype=np.float64)
        slope = float(np.polyfit(ticks, local, 1)[0])
        self._ns_per_tick = min(max(slope, nominal * (1 - MAX_DRIFT)), nominal * (1 + MAX_DRIFT))
        offset = float(np.mean(local - self._ns_per_tick * ticks))
        self._origin = newest._replace(local_ns=newest.local_ns + round(offset))
        self._error_ns = best.error_ns
