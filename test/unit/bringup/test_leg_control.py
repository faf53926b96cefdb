"""The example controller never moves on a guess."""

import math

import pytest

from knee_gap_bringup.leg_control import Action, LegParameters, decide

PARAMETERS = LegParameters(instrument_diameter=0.004, largest_gap=0.012)


@pytest.mark.parametrize(
    ("valid", "gap_min", "gap_max"),
    [
        (False, 0.005, 0.006),
        (True, math.nan, 0.006),
        (True, 0.003, math.nan),
        (True, 0.003, math.inf),
        (True, 0.003, 0.013),
    ],
)
def test_holds_on_what_is_not_known_or_at_the_limit(valid: bool, gap_min: float, gap_max: float) -> None:
    command = decide(valid, 0.05, gap_min, gap_max, PARAMETERS)
    assert command.action is Action.HOLD
    assert command.opening_rate == 0.0


def test_opens_while_the_lower_bound_is_too_small() -> None:
    command = decide(True, 0.05, 0.0039, 0.006, PARAMETERS)
    assert command.action is Action.OPEN
    assert command.opening_rate == PARAMETERS.opening_rate


def test_passes_on_the_lower_bound_not_on_the_estimate() -> None:
    assert decide(True, 0.05, 0.004, 0.02, PARAMETERS).action is Action.PASS


@pytest.mark.parametrize("age", [0.6, -0.6, math.nan])
def test_holds_on_an_estimate_that_is_not_of_now(age: float) -> None:
    command = decide(True, age, 0.005, 0.006, PARAMETERS)
    assert command.action is Action.HOLD
    assert command.opening_rate == 0.0


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="must exceed instrument_diameter"):
        LegParameters(instrument_diameter=0.013, largest_gap=0.012)
