"""Random conversations with the example controller break no rule, and find one that is missing."""

import fuzz_leg_control
import pytest

from knee_gap_bringup.leg_control import LegControl


def test_ten_thousand_random_conversations_break_no_rule() -> None:
    # bench/fuzz_leg_control.py plays a hundred thousand.
    counts = fuzz_leg_control.run(10_000, seed=1)
    # It does not hold the leg for ever either.
    assert counts["open"] > 5_000
    assert counts["instrument may pass"] > 4_000


@pytest.mark.parametrize("rule", ["fault_of", "refusal_of"])
def test_the_random_conversations_find_a_rule_that_is_missing(rule, monkeypatch) -> None:
    monkeypatch.setattr(f"knee_gap_bringup.leg_control.{rule}", lambda *_: "")
    with pytest.raises(AssertionError):
        fuzz_leg_control.run(2000, seed=2)


@pytest.mark.parametrize("method", ["_contradiction", "_note_track", "on_publishers"])
def test_they_find_a_controller_without_memory(method, monkeypatch) -> None:
    def forgetful(control, estimate=None, now=0.0):
        if method == "_note_track":
            control._first_image = {estimate.track_id: now}

    monkeypatch.setattr(LegControl, method, forgetful)
    with pytest.raises(AssertionError):
        fuzz_leg_control.run(2000, seed=3)
