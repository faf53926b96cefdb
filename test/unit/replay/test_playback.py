"""Messages are due by absolute deadlines: none early, none left out, no delay adds up."""

import threading
from collections.abc import Iterator
from itertools import pairwise
from typing import ClassVar

import pytest

from knee_gap_core.bag.bag import BagMessage
from knee_gap_core.bag.errors import BagError
from knee_gap_replay.playback import (
    Controls,
    Event,
    Pace,
    play_once,
    read_ahead,
    window,
    with_clock,
    without_clock,
)

PERIOD_NS = 16_666_667


class Wall:
    """A clock that moves only by waiting and by what publishing costs."""

    def __init__(self, cost_ns: int = 0, stop_after: int | None = None) -> None:
        self.now_ns = 5_000_000_000
        self.cost_ns = cost_ns
        self.stop_after = stop_after
        self.emitted: list[tuple[int, Event]] = []

    def emit(self, event: Event) -> None:
        self.emitted.append((self.now_ns, event))
        self.now_ns += self.cost_ns

    def wait(self, seconds: float) -> bool:
        self.now_ns += round(seconds * 1e9)
        return self.stop_after is not None and len(self.emitted) >= self.stop_after


def messages(count: int) -> list[BagMessage]:
    return [BagMessage("/image", "t", 777 + index * PERIOD_NS, b"") for index in range(count)]


@pytest.mark.parametrize("rate", [0.5, 1.0, 3.0])
def test_every_message_is_emitted_on_its_deadline(rate: float) -> None:
    wall = Wall(cost_ns=1_000_000)
    begin_ns = wall.now_ns
    played = play_once(
        without_clock(messages(600)), Pace(begin_ns, rate), wall.emit, lambda: wall.now_ns, wall.wait
    )
    assert played.message_count == len(wall.emitted) == 600
    for index, (at_ns, event) in enumerate(wall.emitted):
        assert event.message is not None
        assert at_ns - begin_ns == pytest.approx(index * PERIOD_NS / rate, abs=2)
    assert played.end_ns == wall.emitted[-1][0] == pytest.approx(begin_ns + 599 * PERIOD_NS / rate, abs=2)
    assert played.latest_ns == pytest.approx(1_000_000, abs=2)


def test_after_a_delay_what_is_late_comes_at_once_and_the_rest_in_time() -> None:
    wall = Wall()
    pace = Pace(wall.now_ns, 1.0)
    begin_ns = wall.now_ns

    def emit(event: Event) -> None:
        wall.emit(event)
        if len(wall.emitted) == 10:
            wall.now_ns += 10 * PERIOD_NS

    play_once(without_clock(messages(60)), pace, emit, lambda: wall.now_ns, wall.wait)
    late = [at_ns - begin_ns - index * PERIOD_NS for index, (at_ns, _) in enumerate(wall.emitted)]
    assert late[10] == pytest.approx(9 * PERIOD_NS, abs=2)
    assert all(abs(value) <= 2 for value in late[20:])
    assert len(late) == 60


def test_playing_stops_when_told() -> None:
    wall = Wall(stop_after=7)
    played = play_once(without_clock(messages(60)), Pace(0, 1.0), wall.emit, lambda: wall.now_ns, wall.wait)
    assert played.message_count == 7


def test_the_clock_ticks_regularly_and_never_lags_a_message() -> None:
    events = list(with_clock(messages(100), period_ns=10_000_000))
    ticks = [event.time_ns for event in events if event.message is None]
    assert {b - a for a, b in pairwise(ticks)} == {10_000_000}
    assert [event.time_ns for event in events] == sorted(event.time_ns for event in events)
    clock = -1
    for event in events:
        if event.message is None:
            clock = event.time_ns
        else:
            assert 0 <= event.time_ns - clock < 10_000_000


def play(wall: Wall, count: int, controls: Controls, rate: float = 1.0) -> list[int]:
    """Return when each message was emitted, from the begin on."""
    begin_ns = wall.now_ns
    pace = Pace(begin_ns, rate)
    play_once(without_clock(messages(count)), pace, wall.emit, lambda: wall.now_ns, wall.wait, controls)
    return [at_ns - begin_ns for at_ns, _ in wall.emitted]


def test_a_pause_delays_what_follows_and_a_step_gives_one_message() -> None:
    controls = Controls()

    class Pressing(Wall):
        """Pauses at 0.5 s, steps at 1 and 1.5 s, goes on at 2 s."""

        keys: ClassVar = {0.5: " ", 1.0: "n", 1.5: "right", 2.0: " "}

        def wait(self, seconds: float) -> bool:
            stop = super().wait(seconds)
            for at in [at for at in self.keys if at <= self.now_ns * 1e-9 - 5.0]:
                controls.press(self.keys.pop(at))
            return stop

    times = play(Pressing(), 60, controls)
    assert len(times) == 60
    before = [t for t in times if t < 0.52e9]
    stepped = [t for t in times if 0.52e9 < t < 1.99e9]
    assert 29 <= len(before) <= 32
    assert stepped == pytest.approx([1.0e9, 1.5e9], abs=0.04e9)
    after = times[len(before) + 2 :]
    assert after[0] == pytest.approx(2.0e9, abs=0.05e9)
    assert {round((b - a) / PERIOD_NS, 1) for a, b in pairwise(after)} == {1.0}


def test_keys_change_the_rate_from_where_it_is() -> None:
    controls = Controls()
    controls.press("up")
    times = play(Wall(), 60, controls, rate=2.0)
    steps = [b - a for a, b in pairwise(times)]
    assert steps == pytest.approx([PERIOD_NS / 2.2] * 59, abs=3)


def test_a_part_of_a_bag_begins_with_what_is_kept_for_late_subscribers() -> None:
    info = [BagMessage("/info", "t", time_ns, bytes([time_ns])) for time_ns in (1, 2)]
    poses = [BagMessage("/pose", "t", 10 * index, b"") for index in range(20)]
    given = list(window(sorted([*info, *poses], key=lambda m: m.time_ns), 100, 140, ["/info"]))
    assert [(m.topic, m.time_ns) for m in given] == [
        ("/info", 100), ("/pose", 100), ("/pose", 110), ("/pose", 120), ("/pose", 130)
    ]  # fmt: skip
    assert given[0].data == bytes([2])


def test_reading_ahead_gives_everything_and_passes_errors_on() -> None:
    source = messages(5000)
    assert list(read_ahead(iter(source), threading.Event())) == source

    def broken() -> Iterator[BagMessage]:
        yield from source[:3]
        raise BagError("a bad place")

    ahead = read_ahead(broken(), threading.Event())
    assert [next(ahead) for _ in range(3)] == source[:3]
    with pytest.raises(BagError, match="a bad place"):
        next(ahead)
    left = read_ahead(iter(source), threading.Event())
    next(left)
    left.close()  # type: ignore[attr-defined]
