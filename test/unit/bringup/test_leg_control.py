"""The example controller never moves on a guess."""

import itertools
import math
from typing import Any

import pytest

from knee_gap_bringup.leg_control import (
    INTERVALS,
    MOST_REQUESTS,
    MOST_TRACKS,
    REQUEST_PERIOD,
    STATUS_VALID,
    Action,
    Estimate,
    LegControl,
    LegParameters,
    decide,
)


def at_once(**settings: Any) -> LegParameters:
    """Settings of a controller that opens at the first valid estimate of a track, without waiting."""
    return LegParameters(narrowing_time=0.0, **settings)


PARAMETERS = at_once(instrument_diameter=0.004, largest_gap=0.012)
NARROW = Estimate(is_valid=True, track_id=1, age=0.05, gap=0.005, gap_min=0.0039, gap_max=0.006)
WIDE = NARROW._replace(gap_min=0.0045)
LOST = NARROW._replace(is_valid=False, track_id=0, gap=math.nan, gap_min=math.nan, gap_max=math.nan)

# Valid by their status, and impossible.
FAULTY = {
    "no gap": NARROW._replace(gap=math.nan),
    "no lower bound": NARROW._replace(gap_min=math.nan),
    "no upper bound": NARROW._replace(gap_max=math.nan),
    "infinite": NARROW._replace(gap_max=math.inf),
    "negative": NARROW._replace(gap_min=-0.001),
    "below its bounds": NARROW._replace(gap=0.003),
    "above its bounds": NARROW._replace(gap=0.007),
    "bounds exchanged": NARROW._replace(gap_min=0.006, gap_max=0.0039),
    "fits, bounds exchanged": NARROW._replace(gap_min=0.006, gap_max=0.005, gap=0.0055),
    "no track": NARROW._replace(track_id=0),
}
# Possible, and nothing to act on.
REFUSED = {
    "not valid": NARROW._replace(is_valid=False),
    "lost": LOST,
    "all zero": NARROW._replace(gap=0.0, gap_min=0.0, gap_max=0.0),
    "perhaps closed": NARROW._replace(gap_min=0.0),
    "old": NARROW._replace(age=0.6),
    "0.4 s in the future": NARROW._replace(age=-0.4),
    "51 ms in the future": NARROW._replace(age=-0.051),
    "of no time": NARROW._replace(age=math.nan),
    "as published": NARROW._replace(interval="paper"),
    "at the limit": NARROW._replace(gap_max=0.012),
    "beyond the limit": NARROW._replace(gap_max=0.013),
}


def at_rest(parameters=PARAMETERS, now=10.0):
    """A controller that has started, has requested a new track, and was informed that there is none yet."""
    control = LegControl(parameters, now - 2.0)
    assert control.on_time(now - 0.2).measure_again
    control.on_estimate(LOST._replace(stamp_ns=-(10**6)), now - 0.1)
    return control


def images(*estimates):
    """The same, as images one after the other."""
    return [estimate._replace(stamp_ns=1 + index) for index, estimate in enumerate(estimates)]


@pytest.mark.parametrize("estimate", [*FAULTY.values(), *REFUSED.values()], ids=[*FAULTY, *REFUSED])
def test_holds_on_what_the_rules_refuse(estimate) -> None:
    command = decide(estimate, PARAMETERS)
    assert command.action is Action.HOLD
    assert command.opening_rate == 0.0
    assert at_rest().on_estimate(estimate, 10.0).action is Action.HOLD


@pytest.mark.parametrize("estimate", [*FAULTY.values(), *REFUSED.values()], ids=[*FAULTY, *REFUSED])
def test_inside_a_step_the_same_rules_stop_it_at_once(estimate) -> None:
    control = at_rest(at_once(opening_step=5.0, settling=0.3))
    first, bad, good = images(NARROW, estimate, NARROW)
    assert control.on_estimate(first, 10.0).opening_rate > 0.0
    assert control.on_estimate(bad, 10.1).opening_rate == 0.0
    assert control.on_estimate(good, 10.2).opening_rate == 0.0


@pytest.mark.parametrize("estimate", FAULTY.values(), ids=FAULTY)
def test_what_contradicts_itself_holds_the_leg_until_a_person_resets_it(estimate) -> None:
    control = at_rest(at_once(settling=0.3))
    bad, *good = images(estimate, *[NARROW._replace(track_id=9)] * 4)
    control.on_estimate(bad, 10.0)
    assert control.fault
    assert "until a person resets it" in control.on_estimate(good[0], 10.5).reason
    assert control.reset(11.0) == ""
    assert control.on_estimate(good[1], 11.1).action is Action.HOLD
    assert control.on_estimate(good[2], 11.4).measure_again
    assert control.on_estimate(good[3]._replace(track_id=10), 11.5).action is Action.OPEN


@pytest.mark.parametrize("estimate", REFUSED.values(), ids=REFUSED)
def test_what_is_merely_refused_needs_no_person(estimate) -> None:
    control = at_rest()
    refused, good = images(estimate, NARROW)
    assert control.on_estimate(refused, 10.0).action is Action.HOLD
    assert not control.fault
    if estimate.track_id and not math.isnan(estimate.age):
        assert control.on_estimate(good, 10.1).action is Action.OPEN


@pytest.mark.parametrize(
    "second",
    [
        NARROW._replace(gap_max=0.0061),
        NARROW._replace(track_id=2),
        LOST,
        NARROW._replace(stamp_ns=-1),
        LOST._replace(stamp_ns=-1),
    ],
    ids=["other bounds", "another track", "lost and valid at once", "time back", "lost in the past"],
)
def test_messages_that_contradict_each_other_hold_the_leg(second) -> None:
    control = at_rest()
    assert control.on_estimate(NARROW, 10.0).action is Action.OPEN
    assert control.on_estimate(second, 10.1).action is Action.HOLD
    assert control.fault


def test_the_same_message_again_is_no_contradiction() -> None:
    control = at_rest()
    for estimate in (NARROW, LOST._replace(stamp_ns=2)):
        control.on_estimate(estimate, 10.0)
        control.on_estimate(estimate, 10.1)
    assert not control.fault


def test_an_image_behind_a_statement_of_silence_waits_and_needs_no_person() -> None:
    control = at_rest()
    control.on_estimate(LOST._replace(stamp_ns=100_000_000), 10.0)
    assert control.on_estimate(NARROW._replace(stamp_ns=90_000_000), 10.0).action is Action.HOLD
    assert control.on_estimate(NARROW._replace(stamp_ns=110_000_000), 10.1).action is Action.OPEN
    control.on_estimate(LOST._replace(stamp_ns=9_000_000_000), 10.2)
    control.on_estimate(NARROW._replace(stamp_ns=120_000_000), 10.3)
    assert "backwards" in control.fault


def test_a_second_publisher_holds_the_leg_as_long_as_it_is_there() -> None:
    control = at_rest()
    assert control.on_publishers(frozenset({"a"}), 10.0) is None
    assert control.on_estimate(NARROW, 10.0).action is Action.OPEN
    assert control.on_publishers(frozenset({"a", "b"}), 10.1).action is Action.HOLD
    assert "2 nodes publish the gap" in control.reset(10.2)
    assert control.fault
    control.on_publishers(frozenset({"b"}), 10.3)
    assert control.reset(10.4) == ""
    assert control.on_publishers(frozenset({"b"}), 10.5) is None
    assert control.on_publishers(frozenset(), 10.6) is None
    # A node that took its place is another one, though they never met.
    assert control.on_publishers(frozenset({"c"}), 10.7).action is Action.HOLD
    assert control.fault


def test_numbers_of_two_publishers_are_found_before_their_names_are() -> None:
    control = at_rest()
    ours, others, again = images(*[NARROW] * 3)
    assert control.on_estimate(ours._replace(sequence=70), 10.0).action is Action.OPEN
    assert control.on_estimate(others._replace(sequence=3), 10.1).action is Action.HOLD
    assert control.on_estimate(again._replace(sequence=71), 10.1).action is Action.HOLD
    assert "more than one publisher" in control.fault


def test_a_fault_of_the_controller_itself_holds_the_leg() -> None:
    control = at_rest()
    assert control.on_estimate(NARROW, 10.0).action is Action.OPEN
    assert control.on_fault("something failed", 10.1).opening_rate == 0.0
    assert control.on_estimate(NARROW._replace(stamp_ns=9, track_id=9), 20.0).action is Action.HOLD


def test_opens_while_the_lower_bound_is_too_small() -> None:
    command = decide(NARROW, PARAMETERS)
    assert command.action is Action.OPEN
    assert command.opening_rate == PARAMETERS.opening_rate


def test_passes_on_the_lower_bound_not_on_the_estimate() -> None:
    assert decide(NARROW._replace(gap_min=0.004, gap_max=0.02), PARAMETERS).action is Action.PASS


def test_the_published_interval_can_be_asked_for() -> None:
    paper = LegParameters(interval="paper")
    assert decide(NARROW._replace(interval="paper"), paper).action is Action.OPEN
    assert decide(NARROW, paper).action is Action.HOLD


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"instrument_diameter": 0.013, "largest_gap": 0.012}, "must exceed instrument_diameter"),
        ({"interval": "best"}, "one of: worst_case, paper"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings, words) -> None:
    with pytest.raises(ValueError, match=words):
        LegParameters(**settings)


def test_opens_by_a_step_and_acts_only_on_a_track_begun_at_rest() -> None:
    control = at_rest(at_once(opening_step=0.5, settling=0.3, deadline=1.0), now=0.0)
    first, moving, over, during, resting_leg, later, late, again, open_again = images(
        NARROW,
        NARROW,
        NARROW,
        *[WIDE._replace(track_id=2)] * 4,
        WIDE._replace(track_id=3),
        NARROW._replace(track_id=3),
    )
    assert control.on_estimate(first, 0.0).action is Action.OPEN
    assert control.on_estimate(moving, 0.4).action is Action.OPEN
    assert control.on_estimate(over, 0.5).action is Action.HOLD
    assert control.on_estimate(during, 0.7).action is Action.HOLD
    resting = control.on_estimate(resting_leg, 0.85)
    assert resting.action is Action.HOLD
    assert resting.measure_again
    assert control.on_estimate(later, 1.0).action is Action.HOLD
    assert not control.on_estimate(late, 1.1).measure_again
    assert control.on_estimate(again, 2.0).action is Action.PASS
    assert control.on_estimate(open_again, 2.1).action is Action.OPEN


WAITING = LegParameters(opening_step=0.5, settling=0.3, deadline=1.0, narrowing_time=0.3, longest_wait=1.0)


def actions(control: LegControl, widths: list[float], begin: float = 0.0) -> list[str]:
    """What is commanded for intervals of these widths [mm], a tenth of a second apart, at one lower bound."""
    estimates = images(*[NARROW._replace(gap_max=0.0039 + 1e-3 * width, gap=0.0039) for width in widths])
    return [str(control.on_estimate(one, begin + 0.1 * k).action) for k, one in enumerate(estimates)]


def test_while_the_interval_narrows_the_leg_waits_and_then_opens() -> None:
    # Narrower by a tenth each time, then by too little to count.
    found = actions(at_rest(WAITING, now=0.0), [5.0, 4.5, 4.0, 3.9, 3.9, 3.85, 3.85])
    assert found == ["hold"] * 5 + ["open"] * 2


def test_it_waits_no_longer_than_allowed() -> None:
    widths = [5.0 * 0.9**k for k in range(12)]
    assert actions(at_rest(WAITING, now=0.0), widths) == ["hold"] * 10 + ["open"] * 2


def test_what_fits_meanwhile_passes_at_once_and_what_is_refused_holds() -> None:
    control = at_rest(WAITING, now=0.0)
    waits, lost, fits = images(NARROW, LOST, WIDE)
    assert control.on_estimate(waits, 0.0).reason == "the interval still narrows"
    assert control.on_estimate(lost, 0.1).reason == "the gap is not known"
    assert control.on_estimate(fits, 0.2).action is Action.PASS


def test_each_track_is_waited_for_anew_and_an_old_one_is_not_opened_for() -> None:
    control = at_rest(WAITING, now=0.0)
    first, other, same = images(NARROW, NARROW._replace(track_id=2), NARROW._replace(track_id=2))
    assert control.on_estimate(first, 0.0).action is Action.HOLD
    assert control.on_estimate(other, 0.29).action is Action.HOLD
    assert control.on_estimate(same, 0.58).action is Action.HOLD
    later = same._replace(stamp_ns=9)
    assert control.on_estimate(later, 0.6).action is Action.OPEN


def test_inside_a_step_it_does_not_wait() -> None:
    control = at_rest(WAITING, now=0.0)
    found = actions(control, [5.0, 5.0, 5.0, 5.0, 3.0, 2.0])
    assert found == ["hold"] * 3 + ["open"] * 3


def test_while_the_joint_moves_not_even_that_the_instrument_fits_counts() -> None:
    control = at_rest(at_once(opening_step=0.5, settling=0.3), now=0.0)
    first, fits = images(NARROW, WIDE)
    assert control.on_estimate(first, 0.0).action is Action.OPEN
    assert control.on_estimate(fits, 0.1).action is Action.HOLD


def test_a_track_whose_first_image_is_of_the_motion_is_not_acted_on_though_it_came_after() -> None:
    control = at_rest(at_once(opening_step=0.1, settling=0.3), now=0.0)
    assert control.on_estimate(NARROW, 0.0).action is Action.OPEN
    assert control.on_time(0.1).action is Action.HOLD
    assert control.on_time(0.45).measure_again
    late, fresh = images(NARROW, NARROW._replace(track_id=2, age=0.2))[1:], NARROW._replace(track_id=3)
    assert control.on_estimate(late[0], 0.55).action is Action.HOLD
    assert control.on_estimate(late[0]._replace(stamp_ns=3), 0.6).action is Action.HOLD
    assert control.on_estimate(fresh._replace(stamp_ns=4), 0.7).action is Action.OPEN


def test_time_alone_ends_a_step() -> None:
    control = at_rest(at_once(opening_step=0.1, settling=0.3), now=0.0)
    assert control.on_estimate(NARROW, 0.0).action is Action.OPEN
    assert control.on_time(0.09) is None
    assert control.on_time(0.1).opening_rate == 0.0


def test_a_step_is_shorter_where_the_limit_is_nearer() -> None:
    control = at_rest(at_once(opening_step=5.0, settling=0.3), now=0.0)
    assert control.on_estimate(NARROW._replace(gap_max=0.0119), 0.0).action is Action.OPEN
    assert control.on_time(0.099) is None
    assert control.on_time(0.101).opening_rate == 0.0


def test_a_leg_that_does_not_move_needs_no_time_to_its_limit() -> None:
    assert decide(NARROW, LegParameters(opening_rate=0.0)).action is Action.OPEN
    assert decide(REFUSED["at the limit"], LegParameters(opening_rate=0.0)).action is Action.HOLD


def test_silence_ends_a_step_and_what_comes_after_is_measured_anew() -> None:
    control = at_rest(at_once(opening_step=5.0, settling=0.3), now=0.0)
    first, *after = images(*[NARROW] * 4)
    assert control.on_estimate(first, 0.0).opening_rate > 0.0
    assert control.on_time(0.19) is None
    assert control.on_time(0.21).opening_rate == 0.0
    assert control.on_estimate(after[0], 0.3).action is Action.HOLD
    assert control.on_estimate(after[1], 0.6).measure_again
    assert control.on_estimate(after[2], 0.7).action is Action.HOLD


def test_a_rest_that_ends_in_silence_does_not_make_an_old_track_new() -> None:
    control = at_rest(at_once(opening_step=0.1, settling=0.3), now=0.0)
    first, over, silent, old = images(NARROW, NARROW, LOST, NARROW)
    assert control.on_estimate(first, 0.0).opening_rate > 0.0
    assert control.on_estimate(over, 0.1).action is Action.HOLD
    assert control.on_estimate(silent, 0.5).measure_again
    assert control.on_estimate(old, 0.6).action is Action.HOLD


def test_a_controller_that_starts_acts_on_no_track_that_may_have_begun_before() -> None:
    control = LegControl(at_once(settling=0.3), 10.0)
    running = images(*[WIDE] * 40)
    # It starts, and receives the track at once, or only after it has come to rest: both are of before.
    assert control.on_estimate(running[0], 10.1).action is Action.HOLD
    assert control.on_estimate(running[1], 10.35).measure_again
    late = LegControl(at_once(settling=0.3), 10.0)
    assert late.on_time(10.35).measure_again
    for k in range(30):
        assert late.on_estimate(running[2 + k], 11.0 + 0.016 * k).action is Action.HOLD
    assert late.on_estimate(running[39]._replace(track_id=2), 11.6).action is Action.PASS


def test_a_track_whose_begin_was_not_received_is_not_acted_on() -> None:
    control = at_rest()
    unknown, again, fresh = images(WIDE, WIDE, WIDE._replace(track_id=2))
    # 0.3 s of silence: the track may have begun at any time of it.
    assert control.on_estimate(unknown, 10.3).action is Action.HOLD
    assert control.on_estimate(again, 10.4).action is Action.HOLD
    assert control.on_estimate(fresh, 10.5).action is Action.PASS


def test_a_new_track_is_requested_until_one_comes_and_not_for_ever() -> None:
    control = LegControl(PARAMETERS, 10.0)
    requested, now, k = [], 10.5, 0
    while not control.fault and now < 30.0:
        k, now = k + 1, now + 0.016
        if control.on_estimate(WIDE._replace(stamp_ns=k), now).measure_again:
            requested.append(now)
    assert len(requested) == MOST_REQUESTS
    assert min(b - a for a, b in itertools.pairwise(requested)) >= REQUEST_PERIOD
    assert "no new track after 10 requests" in control.fault
    # A person's reset requests again.
    assert control.reset(now) == ""
    assert control.on_estimate(WIDE._replace(stamp_ns=k + 1), now + 0.6).measure_again
    assert control.on_estimate(WIDE._replace(stamp_ns=k + 2, track_id=2), now + 0.7).action is Action.PASS


def test_no_new_track_is_requested_while_there_is_none() -> None:
    control = at_rest()
    for k in range(1000):
        assert not control.on_estimate(LOST._replace(stamp_ns=k), 10.0 + 0.016 * k).measure_again
    assert not control.fault


def test_memory_is_bounded_however_many_tracks_come() -> None:
    control = at_rest()
    for number in range(1, 3 * MOST_TRACKS):
        control.on_estimate(
            NARROW._replace(track_id=number, stamp_ns=number, is_valid=False), 10.0 + 0.001 * number
        )
    assert len(control._first_image) <= MOST_TRACKS


def test_a_message_of_ros_or_of_a_bag_becomes_an_estimate() -> None:
    messages = pytest.importorskip("knee_gap_msgs.msg")
    message = messages.GapEstimate(status=messages.GapEstimate.STATUS_VALID, track_id=7, gap=0.005)
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 500_000_000
    estimate = Estimate.from_message(message, 12_700_000_000, sequence=3)
    assert estimate.is_valid
    assert estimate.age == pytest.approx(0.2)
    assert (estimate.track_id, estimate.gap, estimate.sequence) == (7, 0.005, 3)
    assert estimate.interval == "worst_case"
    assert messages.GapEstimate.STATUS_VALID == STATUS_VALID
    named = {"worst_case": messages.GapEstimate.INTERVAL_WORST_CASE}
    named["paper"] = messages.GapEstimate.INTERVAL_PAPER
    assert {name: number for number, name in INTERVALS.items()} == named
