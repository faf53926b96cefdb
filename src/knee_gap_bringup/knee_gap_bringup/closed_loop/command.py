"""The command `closed_loop`: the example controller opens a simulated knee until an instrument may pass.

Knee, leg, estimator and controller run in one process, without DDS and faster than real time. What the
estimator is given is drawn from the true knee, as if from images. `--runs` prints a table; it fails (exit
code 1) if an instrument that does not fit was let pass, or the joint was opened beyond its limit.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_bringup.closed_loop.faults import Fault
from knee_gap_bringup.closed_loop.loop import LoopSettings, Outcome, run_loop
from knee_gap_bringup.closed_loop.plot import write_plot
from knee_gap_bringup.leg_control import LegParameters
from knee_gap_core.node.arguments import positive
from knee_gap_core.node.command_line import Parser, run
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_simulation.errors import SimulationError

EACH = "each"
_COLUMNS = (
    "fault",
    "runs",
    "passed",
    "time [s]",
    "beyond need [mm]",
    "passed wrongly",
    "beyond limit",
    "resets",
    "CPU s per s",
)
_FIRST_WIDTH = 16


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """Lines of a table: a row for each fault, and one for all runs.

    Time is the median of the runs in which the instrument passed; beyond need is the greatest true gap less
    the instrument's diameter.
    """
    faults = list(dict.fromkeys(one.settings.fault for one in outcomes))
    rows = [(str(fault), [one for one in outcomes if one.settings.fault is fault]) for fault in faults]
    if len(rows) > 1:
        rows.append(("all", list(outcomes)))
    return [_joined(_COLUMNS), *(_joined(_row(name, chosen)) for name, chosen in rows)]


def _joined(cells: Sequence[str]) -> str:
    numbers = zip(cells[1:], _COLUMNS[1:], strict=True)
    return f"{cells[0]:<{_FIRST_WIDTH}}" + "".join(f"{cell:>{len(name) + 2}}" for cell, name in numbers)


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    times = [one.passed_at for one in outcomes if one.passed]
    beyond = [one.beyond_need for one in outcomes if np.isfinite(one.beyond_need)]
    simulated = max(sum(one.end for one in outcomes), 1e-9)
    return (
        name,
        str(len(outcomes)),
        str(len(times)),
        f"{np.median(times):.1f}" if times else "-",
        f"{1e3 * max(beyond):.2f}" if beyond else "-",
        str(sum(one.wrongly_passed for one in outcomes)),
        str(sum(one.beyond_limit for one in outcomes)),
        str(sum(one.resets for one in outcomes)),
        f"{sum(one.cpu_seconds for one in outcomes) / simulated:.2f}",
    )


def line(outcome: Outcome) -> str:
    """One run in a line."""
    what = (
        f"passed after {outcome.passed_at:.1f} s"
        if outcome.passed
        else f"not passed in {outcome.end:.1f} s ({outcome.last_reason})"
    )
    return (
        f"seed {outcome.settings.seed}, fault {outcome.settings.fault}: {what}; true gap "
        f"{1e3 * outcome.true_gap:.2f} mm, {1e3 * outcome.beyond_need:+.2f} mm beyond need; "
        f"{outcome.cpu_seconds / outcome.end:.2f} CPU s per simulated second"
    )


def _settings(arguments: argparse.Namespace) -> LoopSettings:
    """The settings that all runs share. Raises ConfigurationError."""
    defaults = LegParameters()
    try:
        leg = dataclasses.replace(
            defaults,
            instrument_diameter=1e-3 * arguments.instrument_mm,
            largest_gap=1e-3 * arguments.limit_mm,
        )
    except ValueError as error:
        raise ConfigurationError(str(error)) from None
    if arguments.duration_s > 600.0:
        raise ConfigurationError(f"--duration-s must be at most 600, not {arguments.duration_s:g}")
    return LoopSettings(arguments.seed, leg=leg, level=arguments.level, duration=arguments.duration_s)


def _run(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    faults = list(Fault) if EACH in arguments.fault else [Fault(name) for name in arguments.fault]
    jobs = [
        dataclasses.replace(settings, seed=settings.seed + index, fault=faults[index % len(faults)])
        for index in range(arguments.runs)
    ]
    outcomes: list[Outcome] = []
    unfit = 0
    for job in tqdm(jobs, disable=not sys.stderr.isatty() or len(jobs) == 1, leave=False):
        try:
            outcomes.append(run_loop(job))
        except SimulationError as error:
            if len(jobs) == 1:
                raise ConfigurationError(f"seed {job.seed}: {error}") from None
            unfit += 1
    if not outcomes:
        raise ConfigurationError("the scope fits into none of these knees; choose another --seed")
    # The plot is of the run that is most worth looking at.
    worst = max(outcomes, key=lambda one: (one.wrongly_passed, one.beyond_limit, not one.passed))
    if len(jobs) == 1:
        print(line(worst))
    else:
        print("\n".join(table(outcomes)))
        if unfit:
            print(f"{unfit} knees were left out: the scope does not fit into them")
    write_plot(worst, Path(arguments.out))
    print(f"closed_loop: {arguments.out} shows seed {worst.settings.seed}")
    return int(any(one.wrongly_passed or one.beyond_limit for one in outcomes))


def _runs(text: str) -> int:
    """A whole number from 1 to 10000, for `type=` of an argument."""
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 10000, is {text}")
    return int(text)


def _seed(text: str) -> int:
    """A whole number of at least 0, for `type=` of an argument."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"must be a whole number, 0 or more, is {text}")
    return int(text)


def _parser() -> Parser:
    defaults = LegParameters()
    parser = Parser(prog="closed_loop", description=__doc__)
    parser.add_argument("--seed", type=_seed, default=1, help="of the first run (1)")
    parser.add_argument("--runs", type=_runs, default=1, metavar="N", help="runs with different seeds (1)")
    parser.add_argument(
        "--fault",
        nargs="+",
        choices=[*Fault, EACH],
        default=[Fault.NONE],
        help="faults, in turn over the runs; each: all of them (none)",
    )
    parser.add_argument("--level", type=int, choices=range(4), default=1, help="unevenness of the knee (1)")
    parser.add_argument(
        "--instrument-mm",
        type=positive,
        default=1e3 * defaults.instrument_diameter,
        help=f"diameter of the instrument ({1e3 * defaults.instrument_diameter:g})",
    )
    parser.add_argument(
        "--limit-mm",
        type=positive,
        default=1e3 * defaults.largest_gap,
        help=f"largest gap that the joint's limits allow ({1e3 * defaults.largest_gap:g})",
    )
    parser.add_argument(
        "--duration-s", type=positive, default=60.0, help="simulated time after which a run is given up (60)"
    )
    parser.add_argument("--out", default="out/closed_loop.png", metavar="PNG", help="plot of a run")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run closed loops; return 0 if no instrument was passed wrongly and no limit exceeded."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
