"""What a core raises ends at its message: refused, counted, reported once with its place."""

import inspect
import os
from collections.abc import Iterator
from functools import partial

import pytest

from knee_gap_core.node import seam as module
from knee_gap_core.node.parameter_rules import broken_rule
from knee_gap_core.node.seam import STRICT, Fault, Seam


def broken(_: object = None) -> list[int]:
    raise ValueError("a  number\nthat is none")


def test_tests_are_strict() -> None:
    assert os.environ[STRICT] == "1"
    with pytest.raises(ValueError, match="that is none"):
        Seam().call("image", lambda _: [], broken)


def test_an_exception_refuses_one_message_and_is_counted_by_its_place() -> None:
    reported: list[Fault] = []
    seam = Seam(reported.append, strict=False)
    assert seam.call("image", lambda _: [0], lambda: [1, 2]) == [1, 2]
    for _ in range(3):
        assert seam.call("image", lambda _: [0], broken) == [0]
    ((reason, count),) = seam.counts.items()
    assert count == 3
    assert reason.startswith("image refused: ValueError in test_seam.py:")
    assert [fault.words for fault in reported] == ["a number that is none"] * 3
    assert "Traceback" in reported[0].traceback
    assert "\n" not in reported[0].line


def test_the_place_is_the_suites_innermost_line() -> None:
    reported: list[Fault] = []
    # Raises within dataclasses.fields, called by a module of the suite.
    Seam(reported.append, strict=False).call("image", lambda _: "", lambda: broken_rule(3))
    assert reported[0].place.startswith("parameter_rules.py:")


def test_items_before_an_exception_count_and_the_answer_to_it_ends_them() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise KeyError("k")

    seam = Seam(strict=False)
    assert list(seam.each("image", lambda _: [7], items())) == [1, 2, 7]
    assert list(seam.each("image", lambda _: [7], [4])) == [4]
    assert seam.counts.total() == 1


def test_a_guarded_function_keeps_its_signature_and_its_arguments() -> None:
    def take(message: int, info: int) -> int:
        return message // info

    seam = Seam(strict=False)
    guarded = seam.guarded("image", lambda fault, message, info: -message, take)
    assert inspect.signature(guarded) == inspect.signature(take)
    assert guarded(6, 2) == 3
    assert guarded(6, 0) == -6
    half = seam.guarded("image", lambda _, info: info, partial(take, 8))
    assert len(inspect.signature(half).parameters) == 1
    assert half(4) == 2


def test_what_is_no_fault_of_a_message_goes_through() -> None:
    seam = Seam(passes=lambda error: isinstance(error, EOFError), strict=False)

    def shut_down() -> None:
        raise EOFError

    def interrupt() -> None:
        raise KeyboardInterrupt

    for raises, kind in ((shut_down, EOFError), (interrupt, KeyboardInterrupt)):
        with pytest.raises(kind):
            seam.call("image", lambda _: None, raises)
    assert not seam.counts


def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, strict in (("", False), ("0", False), ("1", True)):
        monkeypatch.setenv(module.STRICT, value)
        assert Seam().strict is strict
