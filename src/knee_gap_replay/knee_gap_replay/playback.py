"""Due times of the messages of a bag: absolute deadlines, so that delays do not add up; pause and steps."""

import queue
import threading
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from knee_gap_core.bag.bag import BagMessage

CLOCK_PERIOD_NS = 10_000_000
# How soon a key is heeded [s], and the factor by which one changes the rate.
_SLICE_SECONDS = 0.02
RATE_STEP = 1.1
# Messages read ahead, so that the disk and the parser delay none.
_MOST_AHEAD_BYTES = 64 << 20
_MOST_AHEAD = 2_000


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


def window(
    messages: Iterable[BagMessage], begin_ns: int, end_ns: int | None, latched: Collection[str] = ()
) -> Iterator[BagMessage]:
    """Yield the messages from a time on and before another.

    Of the `latched` topics, a subscriber that joins at `begin_ns` would have received the last message before
    it: that one is given first, at that time.
    """
    kept: dict[str, BagMessage] = {}
    for message in messages:
        if message.time_ns < begin_ns:
            if message.topic in latched:
                kept[message.topic] = message._replace(time_ns=begin_ns)
            continue
        if end_ns is not None and message.time_ns >= end_ns:
            break
        yield from kept.values()
        kept.clear()
        yield message
    yield from kept.values()


def read_ahead(messages: Iterable[BagMessage], stop: threading.Event) -> Iterator[BagMessage]:
    """Yield the messages, read by a thread of their own; raises what reading raises."""
    waiting: queue.SimpleQueue[BagMessage | BaseException | None] = queue.SimpleQueue()
    room = threading.Condition()
    held = [0, 0]  # bytes, messages
    ended = threading.Event()

    def read() -> None:
        try:
            for message in messages:
                with room:
                    while (held[0] > _MOST_AHEAD_BYTES or held[1] > _MOST_AHEAD) and not ended.is_set():
                        room.wait(0.1)
                    held[0] += len(message.data)
                    held[1] += 1
                if ended.is_set() or stop.is_set():
                    break
                waiting.put(message)
        except BaseException as error:  # raised again where the messages are taken
            waiting.put(error)
        waiting.put(None)

    reader = threading.Thread(target=read, name="bag reader", daemon=True)
    reader.start()
    try:
        while (item := waiting.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            with room:
                held[0] -= len(item.data)
                held[1] -= 1
                room.notify()
            yield item
    finally:
        ended.set()
        reader.join()


class Pace:
    """Due times of one pass through a bag; `begin_ns` is the first message's, on the caller's clock."""

    def __init__(self, begin_ns: int, rate: float) -> None:
        self._begin_ns = begin_ns
        self.rate = rate
        self._first_ns: int | None = None

    def due_ns(self, time_ns: int) -> int:
        """Return when an event at `time_ns` of the bag is due, on the caller's clock."""
        if self._first_ns is None:
            self._first_ns = time_ns
        return self._begin_ns + round((time_ns - self._first_ns) / self.rate)

    def delay(self, delay_ns: int) -> None:
        """Let everything be due so much later; or earlier, if negative."""
        self._begin_ns += delay_ns

    def change(self, rate: float, now_ns: int, time_ns: int) -> None:
        """Go on at another rate, where an event at `time_ns` of the bag is the next."""
        left_ns = max(0, self.due_ns(time_ns) - now_ns) * self.rate / rate
        self._begin_ns, self._first_ns, self.rate = now_ns + round(left_ns), time_ns, rate


@dataclass
class Controls:
    """What a user wants meanwhile; set by the thread that reads the keyboard."""

    paused: bool = False
    steps: int = 0
    rate_factor: float = 1.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def press(self, key: str) -> None:
        """Take a key: space pauses and goes on, n or right gives one message, up and down change the rate."""
        with self._lock:
            if key == " ":
                self.paused, self.steps = not self.paused, 0
            elif key in ("n", "right"):
                self.paused = True
                self.steps += 1
            elif key in ("up", "down"):
                self.rate_factor *= RATE_STEP if key == "up" else 1.0 / RATE_STEP

    def take_step(self) -> bool:
        """Return whether one message is to be given although playing is paused."""
        with self._lock:
            if self.steps == 0:
                return False
            self.steps -= 1
            return True


class Played(NamedTuple):
    """Result of one pass: number of messages, delays [ns], and end time on the caller's clock."""

    message_count: int
    latest_ns: int
    end_ns: int
    late_ns: "array[int]" = array("q")

    def late_words(self) -> str:
        """Report how late the messages were."""
        usual = float(np.percentile(self.late_ns, 99)) if self.late_ns else 0.0
        return f"at most {self.latest_ns * 1e-6:.1f} ms late, 99 % within {usual * 1e-6:.2f} ms"


def play_once(
    events: Iterable[Event],
    pace: Pace,
    emit: Callable[[Event], None],
    now_ns: Callable[[], int],
    wait: Callable[[float], bool],
    controls: Controls | None = None,
) -> Played:
    """Emit every event at its due time, or at once if it is late. No event is early or dropped.

    `wait(seconds)` returns True if playing is to stop.
    """
    end_ns = 0
    late_ns = array("q")
    controls = controls or Controls()
    rate = pace.rate
    stepping = False
    for event in events:
        if _stopped_before(event, pace, now_ns, wait, controls, rate=rate, stepping=stepping):
            break
        end_ns = pace.due_ns(event.time_ns)
        emit(event)
        stepping = controls.paused and event.message is None and stepping
        if event.message is not None:
            late_ns.append(max(0, now_ns() - end_ns))
    return Played(len(late_ns), max(late_ns, default=0), end_ns, late_ns)


def _stopped_before(
    event: Event,
    pace: Pace,
    now_ns: Callable[[], int],
    wait: Callable[[float], bool],
    controls: Controls,
    *,
    rate: float,
    stepping: bool,
) -> bool:
    """Wait until an event is due; return whether playing is to stop."""
    while True:
        wanted = rate * controls.rate_factor
        if wanted != pace.rate:
            pace.change(wanted, now_ns(), event.time_ns)
        if controls.paused:
            if stepping or controls.take_step():
                pace.delay(now_ns() - pace.due_ns(event.time_ns))
                return wait(0.0)
            begun_ns = now_ns()
            pace.due_ns(event.time_ns)
            if wait(_SLICE_SECONDS):
                return True
            pace.delay(now_ns() - begun_ns)
            continue
        early = (pace.due_ns(event.time_ns) - now_ns()) * 1e-9
        if early <= 2 * _SLICE_SECONDS:
            if wait(max(early, 0.0)):
                return True
            if not controls.paused:
                return False
        elif wait(_SLICE_SECONDS):
            return True
