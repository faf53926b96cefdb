"""Due times of the messages of a bag: absolute deadlines, so that delays do not add up."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from knee_gap_core.bag.bag import BagMessage

CLOCK_PERIOD_NS = 10_000_000


class Event(NamedTuple):
    """A message to publish, or a tick of the bag's clock (message None), at `time_ns` of the bag."""

    time_ns: int
    message: BagMessage | None


def with_clock(messages: Iterable[BagMessage], period_ns: int = CLOCK_PERIOD_NS) -> Iterator[Event]:
    """Yield the messages, each after the clock ticks up to its time, so that the clock is never behind it."""
    tick_ns: int | None = None
    for message in messages:
        tick_ns = message.time_ns if tick_ns is None else tick_ns
        while tick_ns <= message.time_ns:
            yield Event(tick_ns, None)
            tick_ns += period_ns
        yield Event(message.time_ns, message)


def without_clock(messages: Iterable[BagMessage]) -> Iterator[Event]:
    """Yield the messages alone."""
    for message in messages:
        yield Event(message.time_ns, message)


class Pace:
    """Due times of one pass through a bag; `begin_ns` is the first message's, on the caller's clock."""

    def __init__(self, begin_ns: int, rate: float) -> None:
        self._begin_ns = begin_ns
        self._rate = rate
        self._first_ns: int | None = None

    def due_ns(self, time_ns: int) -> int:
        """Return when an event at `time_ns` of the bag is due, on the caller's clock."""
        if self._first_ns is None:
            self._first_ns = time_ns
        return self._begin_ns + round((time_ns - self._first_ns) / self._rate)


class Played(NamedTuple):
    """Result of one pass: number of messages, largest delay, and end time on the caller's clock."""

    message_count: int
    latest_ns: int
    end_ns: int


def play_once(
    events: Iterable[Event],
    pace: Pace,
    emit: Callable[[Event], None],
    now_ns: Callable[[], int],
    wait: Callable[[float], bool],
) -> Played:
    """Emit every event at its due time, or at once if it is late. No event is early or dropped.

    `wait(seconds)` returns True if playing is to stop.
    """
    count = latest_ns = end_ns = 0
    for event in events:
        end_ns = pace.due_ns(event.time_ns)
        early_ns = end_ns - now_ns()
        if wait(max(early_ns, 0) * 1e-9):
            break
        emit(event)
        if event.message is not None:
            count += 1
            latest_ns = max(latest_ns, now_ns() - end_ns)
    return Played(count, latest_ns, end_ns)
