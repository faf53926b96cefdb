"""Messages are due by absolute deadlines: none early, none left out, no delay adds up."""

from itertools import pairwise

import pytest

from knee_gap_core.bag.bag import BagMessage
from knee_gap_replay.playback import Event, Pace, play_once, with_clock, without_clock

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
