"""Missing images are reported by the camera's own interval: neither between two images nor late."""

import pytest

from knee_gap_uncertainty.inputs.silence import LONGEST_INTERVAL, Silence

MS = 1_000_000
MARGIN = 0.03


def after_images(interval_ns: int, count: int = 12) -> tuple[Silence, int]:
    """A watch that has seen images at an interval, and the time of the last."""
    silence = Silence(MARGIN)
    for index in range(count):
        silence.add(index * interval_ns, index * interval_ns)
    return silence, (count - 1) * interval_ns


@pytest.mark.parametrize("rate", [15, 25, 30, 60])
def test_nothing_is_missing_between_two_images(rate: int) -> None:
    interval = 10**9 // rate
    silence, last = after_images(interval)
    assert not silence.is_due(last + interval + 10 * MS)


@pytest.mark.parametrize("rate", [15, 25, 30, 60])
def test_a_missing_image_is_reported_within_its_interval_and_the_margin(rate: int) -> None:
    interval = 10**9 // rate
    silence, last = after_images(interval)
    assert silence.is_due(last + interval + 31 * MS)


def test_the_first_interval_is_taken_for_the_longest() -> None:
    silence = Silence(MARGIN)
    silence.add(0, 0)
    assert not silence.is_due(100 * MS)
    assert silence.is_due(101 * MS)


def test_a_slow_camera_is_silent_between_its_images() -> None:
    silence, last = after_images(200 * MS)
    assert silence.is_due(last + round(LONGEST_INTERVAL * 1e9) + 31 * MS)


def test_silence_is_repeated_at_the_margin() -> None:
    silence, last = after_images(16 * MS)
    now = last + 60 * MS
    silence.report(now)
    assert not silence.is_due(now + 30 * MS)
    assert silence.is_due(now + 31 * MS)


def test_one_lost_image_does_not_change_the_usual_interval() -> None:
    silence, last = after_images(16 * MS)
    silence.add(last + 48 * MS, last + 48 * MS)
    assert silence.is_due(last + (48 + 16 + 31) * MS)


def test_a_recording_played_slowly_is_not_silent_between_its_messages() -> None:
    silence = Silence(MARGIN)
    for index in range(12):
        silence.add(index * 8 * MS, index * 33 * MS)
    assert not silence.is_due((11 * 33 + 33 + 10) * MS)
    assert silence.is_due((11 * 33 + 33 + 31) * MS)


def test_stamps_that_run_backwards_begin_again() -> None:
    silence, last = after_images(16 * MS)
    silence.add(0, last + 16 * MS)
    assert not silence.is_due(last + (16 + 99) * MS)
