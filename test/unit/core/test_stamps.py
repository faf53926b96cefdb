"""Stamps of messages survive the way to whole nanoseconds and back."""

from types import SimpleNamespace

import pytest

from knee_gap_core.values.stamps import set_stamp, stamp_ns


def header(sec: int = 0, nanosec: int = 0) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


@pytest.mark.parametrize("stamp", [0, 1, 999_999_999, 1_000_000_000, 1_699_999_999_954_700_001])
def test_a_stamp_comes_back_as_it_was_set(stamp: int) -> None:
    message = header()
    set_stamp(message, stamp)
    assert 0 <= message.stamp.nanosec < 1_000_000_000
    assert stamp_ns(message) == stamp


def test_nanoseconds_beyond_a_second_do_not_reach_the_next_one() -> None:
    assert stamp_ns(header(5, 1_000_000_000)) < stamp_ns(header(6))
    assert stamp_ns(header(5, 4_294_967_295)) == 5_999_999_999
