"""The example controller never moves on a guess."""

import math

import pytest

from knee_gap_bringup.leg_control import Action, Estimate, LegControl, LegParameters, decide

PARAMETERS = LegParameters(instrument_diameter=0.004, largest_gap=0.012)
NARROW = Estimate(is_valid=True, track_id=1, age=0.05, gap_min=0.0039, gap_max=0.006)
WIDE = NARROW._replace(gap_min=0.0045)


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
    command = decide(Estimate(valid, 1, 0.05, gap_min, gap_max), PARAMETERS)
    assert command.action is Action.HOLD
    assert command.opening_rate == 0.0


def test_opens_while_the_lower_bound_is_too_small() -> None:
    command = decide(NARROW, PARAMETERS)
    assert command.action is Action.OPEN
    assert command.opening_rate == PARAMETERS.opening_rate


def test_passes_on_the_lower_bound_not_on_the_estimate() -> None:
    assert decide(NARROW._replace(gap_min=0.004, gap_max=0.02), PARAMETERS).action is Action.PASS


@pytest.mark.parametrize("age", [0.6, -0.6, math.nan])
def test_holds_on_an_estimate_that_is_not_of_now(age: float) -> None:
    command = decide(NARROW._replace(age=age), PARAMETERS)
    assert command.action is Action.HOLD
    assert command.opening_rate == 0.0


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="must exceed instrument_diameter"):
        LegParameters(instrument_diameter=0.013, largest_gap=0.012)


def test_opens_by_a_step_and_believes_only_a_track_begun_at_rest() -> None:
    control = LegControl(LegParameters(opening_step=0.5, settling=0.3))
    assert control.on_estimate(NARROW, 0.0).action is Action.OPEN
    # While the joint moves nothing that is measured counts, not even that the instrument fits.
    assert control.on_estimate(WIDE, 0.4).action is Action.OPEN
    assert control.on_estimate(WIDE, 0.5).action is Action.HOLD
    during = WIDE._replace(track_id=2)
    assert control.on_estimate(during, 0.7).action is Action.HOLD
    at_rest = control.on_estimate(during, 0.85)
    assert at_rest.action is Action.HOLD
    assert at_rest.measure_anew
    assert control.on_estimate(during, 1.0).action is Action.HOLD
    assert not control.on_estimate(during, 1.1).measure_anew
    anew = WIDE._replace(track_id=3)
    assert control.on_estimate(anew, 2.0).action is Action.PASS
    assert control.on_estimate(NARROW._replace(track_id=3), 2.1).action is Action.OPEN


def test_silence_ends_a_step_and_what_comes_after_is_measured_anew() -> None:
    control = LegControl(LegParameters(opening_step=5.0, settling=0.3))
    assert control.on_estimate(NARROW, 0.0).opening_rate > 0.0
    assert control.on_silence(0.2).opening_rate == 0.0
    assert control.on_estimate(NARROW, 0.3).action is Action.HOLD
    assert control.on_estimate(NARROW, 0.6).measure_anew
    assert control.on_estimate(NARROW, 0.7).action is Action.HOLD


def test_a_step_ends_where_nothing_is_seen_any_more() -> None:
    control = LegControl(LegParameters(opening_step=5.0, settling=0.3))
    assert control.on_estimate(NARROW, 0.0).opening_rate > 0.0
    moved = NARROW._replace(is_valid=False)
    assert control.on_estimate(moved, 0.1).opening_rate > 0.0
    assert control.on_estimate(moved._replace(is_blind=True), 0.2).opening_rate == 0.0
    assert control.on_estimate(NARROW, 0.3).action is Action.HOLD


def test_a_rest_that_ends_in_silence_does_not_make_an_old_track_new() -> None:
    control = LegControl(LegParameters(opening_step=0.1, settling=0.3))
    assert control.on_estimate(NARROW, 0.0).opening_rate > 0.0
    assert control.on_estimate(NARROW, 0.1).action is Action.HOLD
    silent = NARROW._replace(is_valid=False, track_id=0, is_blind=True)
    assert control.on_estimate(silent, 0.5).measure_anew
    assert control.on_estimate(NARROW, 0.6).action is Action.HOLD
