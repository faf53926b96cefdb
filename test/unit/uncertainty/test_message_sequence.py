"""Messages of two publishers never pass for those of one."""

import itertools
import random

import pytest

from knee_gap_uncertainty.inputs.message_sequence import MessageSequence


def breaks(numbers: list[int | None], period: float = 0.008) -> list[bool]:
    sequence = MessageSequence()
    return [not sequence.continues(number, 50.0 + k * period) for k, number in enumerate(numbers)]


def test_one_publisher_has_no_break_wherever_it_is_heard_from() -> None:
    assert not any(breaks(list(range(1, 50))))
    assert not any(breaks(list(range(700, 750))))


def test_what_a_full_queue_lost_while_the_subscriber_stood_still_is_no_break() -> None:
    assert not any(breaks([5, 6, 90, 91], period=0.31))
    # A publisher that was started again meanwhile is one all the same.
    assert breaks([5, 6, 1, 2], period=0.31) == [False, False, True, False]


def test_a_publisher_started_again_and_a_jump_ahead_are_one_break_each() -> None:
    assert breaks([5, 6, 1, 2, 3]) == [False, False, True, False, False]
    assert breaks([5, 6, 9, 10]) == [False, False, True, False]
    assert breaks([5, 5]) == [False, True]


def test_a_middleware_without_numbers_has_no_breaks() -> None:
    assert not any(breaks([None, None, None]))
    assert not any(breaks([3, None, 1]))


@pytest.mark.parametrize("ahead", [-60, -2, -1, 0, 1, 2, 60])
def test_no_two_messages_of_one_of_two_publishers_come_without_a_break_between(ahead: int) -> None:
    order = random.Random(3)
    own, other = itertools.count(100), itertools.count(100 + ahead)
    sent = [(who, next(own if who else other)) for who in (order.random() < 0.5 for _ in range(400))]
    broken = breaks([number for _, number in sent])
    changes = [k for k in range(1, len(sent)) if sent[k][0] != sent[k - 1][0]]
    for k, following in itertools.pairwise([*changes, len(sent)]):
        # Of both changes, to the other and back, at least one shows.
        assert any(broken[k : following + 1])
