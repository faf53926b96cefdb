"""The closed loop: the leg obeys late; an instrument that passes and does not fit would be reported."""

from dataclasses import replace

import numpy as np
import pytest

from knee_gap_bringup.closed_loop import command, loop
from knee_gap_bringup.closed_loop.faults import Fault, FaultSchedule
from knee_gap_bringup.closed_loop.leg import LegMechanics, SimulatedLeg
from knee_gap_bringup.closed_loop.loop import ClosedLoop, LoopSettings, Outcome, run_loop
from knee_gap_bringup.leg_control import TICK, Action, Estimate, LegParameters
from knee_gap_simulation.errors import SimulationError

MECHANICS = LegMechanics(greatest_rate=0.003, lag=0.1, backlash=0.4e-3)


def test_the_joint_follows_the_drive_late_and_through_its_play() -> None:
    leg = SimulatedLeg(0.003, MECHANICS)
    openings = []
    for _ in range(100):
        leg.advance(0.001, 0.01)
        openings.append(leg.opening)
    moved = 0.001 * (1.0 - MECHANICS.lag) - MECHANICS.backlash
    assert openings[30] == 0.003
    assert openings[-1] == pytest.approx(0.003 + moved, abs=1e-5)
    for _ in range(100):
        leg.advance(0.0, 0.01)
    # It runs on by the rate times the time constant, and then rests.
    assert leg.opening == pytest.approx(0.003 + moved + 0.001 * MECHANICS.lag, abs=1e-5)
    before = leg.opening
    leg.advance(-0.001, 0.2)
    assert leg.opening == before


def test_the_leg_is_no_faster_than_it_can_be() -> None:
    leg = SimulatedLeg(0.003, replace(MECHANICS, backlash=0.0))
    for _ in range(1000):
        leg.advance(1.0, 0.001)
    assert leg.opening < 0.003 + MECHANICS.greatest_rate


@pytest.mark.parametrize("fault", Fault)
def test_a_fault_is_present_at_its_own_times_alone(fault: Fault) -> None:
    schedule, again = FaultSchedule(fault, 5, 60.0), FaultSchedule(fault, 5, 60.0)
    assert (schedule.spans == again.spans).all()
    comes_and_goes = fault not in (Fault.NONE, Fault.NOISE, Fault.REORDERED)
    assert (len(schedule.spans) > 3) == comes_and_goes
    for begin, end in schedule.spans:
        assert schedule.is_present(fault, 0.5 * (begin + end))
        assert not schedule.is_present(Fault.NONE, 0.5 * (begin + end))
        assert not schedule.is_present(fault, end)


def small(instrument: float, fault: Fault = Fault.NONE, duration: float = 5.0) -> LoopSettings:
    leg = LegParameters(instrument_diameter=instrument)
    return LoopSettings(1, fault, leg, duration=duration)


@pytest.fixture(scope="module")
def thin() -> Outcome:
    """A loop whose instrument is thinner than the joint is open from the start."""
    return run_loop(small(0.0008))


def test_an_instrument_that_fits_is_passed(thin: Outcome) -> None:
    assert thin.passed
    assert not thin.wrongly_passed
    assert not thin.beyond_limit
    valid = [one for one in thin.heard if one.is_valid]
    # The instrument's own lower bound decided, and the truth lies within the bounds.
    assert valid[-1].gap_min >= 0.0008
    assert all(one.gap_min <= thin.true_gap <= one.gap_max for one in valid)


def opening(settings: LoopSettings) -> tuple[ClosedLoop, int]:
    """A loop, advanced until the leg begins to open, and the tick at which it does."""
    closed = ClosedLoop(settings)
    for tick in range(round(5.0 / TICK)):
        closed.advance(tick)
        if closed.command.action is Action.OPEN:
            return closed, tick
    raise AssertionError(closed.command)


def test_the_leg_opens_by_steps_and_is_measured_again() -> None:
    closed, begin = opening(small(0.004))
    assert closed._last is not None
    start, track = closed.leg.opening, closed._last[0].track_id
    for tick in range(begin + 1, begin + round(1.5 / TICK)):
        closed.advance(tick)
    assert closed.leg.opening > start
    assert closed.passed_on is None
    assert closed._last[0].track_id > track


def test_the_joint_is_not_opened_where_it_may_be_at_its_limit() -> None:
    leg = LegParameters(instrument_diameter=0.004, largest_gap=0.0045)
    closed = ClosedLoop(replace(small(0.004), leg=leg))
    upper, begun = [], 0
    for tick in range(round(3.2 / TICK)):
        before = closed.command.action
        closed.advance(tick)
        if closed.heard and closed.heard[-1].is_valid:
            upper.append(closed.heard[-1].gap_max)
        if closed.command.action is Action.OPEN and before is not Action.OPEN:
            begun += 1
            assert upper[-1] < leg.largest_gap
    # Wider bounds came first, and held the leg.
    assert max(upper) > leg.largest_gap
    assert begun
    assert closed.leg.opening < leg.largest_gap


@pytest.mark.parametrize("fault", [Fault.STALE, Fault.SILENT])
def test_the_leg_is_held_while_nothing_is_heard(fault: Fault) -> None:
    closed, begin = opening(small(0.004, fault))
    closed.faults.spans = np.array([[0.0, 100.0]])
    late = begin + round((closed.settings.leg.deadline + 0.04) / TICK)
    for tick in range(begin + 1, late + round(0.5 / TICK)):
        closed.advance(tick)
        assert closed.command.opening_rate == 0.0 or tick <= late
    assert closed.command.action is Action.HOLD


def test_a_wrong_pass_is_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Liar(Estimate):
        @classmethod
        def from_message(cls, message, now_ns, sequence=None):
            one = Estimate.from_message(message, now_ns, sequence)
            return one._replace(gap=one.gap + 0.005, gap_min=one.gap_min + 0.005, gap_max=one.gap_max + 0.005)

    monkeypatch.setattr(loop, "Estimate", Liar)
    out = tmp_path / "plot.png"
    assert command.main(["--seed", "1", "--duration-s", "5", "--out", str(out)]) == 1
    said = capsys.readouterr().out
    assert "passed after" in said
    assert out.read_bytes()[:4] == b"\x89PNG"


def test_the_table_counts_what_must_not_be(thin: Outcome) -> None:
    need = thin.settings.leg.instrument_diameter
    outcomes = [
        thin,
        replace(thin, true_gap=need - 1e-6),  # does not fit
        replace(thin, true_gap=float("nan")),  # not known
        replace(thin, passed_at=float("nan"), true_gap=0.0125),  # beyond 12 mm
        replace(thin, settings=replace(thin.settings, fault=Fault.LOST), resets=2),
    ]
    heads, none, lost, total = command.table(outcomes)
    assert none.split()[:3] == ["none", "4", "3"]
    assert none.split()[4:8] == ["11.70", "2", "1", "0"]
    assert lost.split()[:3] == ["lost", "1", "1"]
    assert total.split()[4:8] == ["11.70", "2", "1", "2"]
    assert len({len(line) for line in (heads, none, lost, total)}) == 1


def test_runs_take_the_faults_in_turn(
    thin: Outcome, monkeypatch: pytest.MonkeyPatch, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def run(settings: LoopSettings) -> Outcome:
        asked.append((settings.seed, settings.fault))
        if settings.seed == 12:
            raise SimulationError("the scope does not fit")
        return replace(thin, settings=settings)

    monkeypatch.setattr(command, "run_loop", run)
    arguments = ["--seed", "10", "--runs", "4", "--out", str(tmp_path / "plot.png"), "--fault"]
    assert command.main([*arguments, "lost", "stale"]) == 1  # 4 mm do not fit: `thin` was of 0.8 mm
    assert asked == [(10, Fault.LOST), (11, Fault.STALE), (12, Fault.LOST), (13, Fault.STALE)]
    assert "1 knees were left out" in capsys.readouterr().out
    asked.clear()
    command.main([*arguments, "each"])
    assert [fault for _, fault in asked] == list(Fault)[:4]


def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["--limit-mm", "3"],
        ["--runs", "0"],
        ["--seed", "-1"],
        ["--fault", "rain"],
        ["--duration-s", "1e9"],
    ):
        try:
            code = command.main(arguments)
        except SystemExit as stop:
            code = int(str(stop.code))
        said = capsys.readouterr().err
        assert code in (1, 2)
        assert said.startswith("closed_loop: ")
        assert said.count("\n") == 1
