"""`study`: the paper's tables and figures computed again, as PNG, SVG, CSV and one HTML page."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_uncertainty.studies.paper.consistency import Check, checks
from knee_gap_uncertainty.studies.paper.figures import cloud_figures, other_figures
from knee_gap_uncertainty.studies.paper.figures.drawing import save
from knee_gap_uncertainty.studies.paper.figures.other_figures import Curve
from knee_gap_uncertainty.studies.paper.geometry import Fit
from knee_gap_uncertainty.studies.paper.geometry_fit import (
    FITTED,
    READINGS,
    REFINED,
    SEED,
    TRIES,
    rms_mm,
    search,
)
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, TABLE_3, TABLE_3_COLUMNS
from knee_gap_uncertainty.studies.paper.study_page import study_page
from knee_gap_uncertainty.studies.paper.table_4 import COLUMNS, Row, cells, rows
from knee_gap_uncertainty.studies.paper.tables import Table, plain, write_csv
from knee_gap_uncertainty.two_view.gap_range import warm_up

SEED_OF_RUNS = 2020
MOST_RUNS = 1_000_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; 0 when all was written, 2 for a user's mistake."""
    parser = Parser(prog="study", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/study"), help="where to write (out/study)")
    parser.add_argument("--runs", type=int, default=1000, help="simulated runs of each scenario (1000)")
    parser.add_argument("--seed", type=int, default=SEED_OF_RUNS, help=f"seed of the runs ({SEED_OF_RUNS})")
    parser.add_argument("--fit", action="store_true", help="search the geometry again, and use what is found")
    options = parser.parse_args(argv)
    if not 2 <= options.runs <= MOST_RUNS:
        return refuse(f"--runs must be from 2 to {MOST_RUNS}, got {options.runs}")
    if options.seed < 0:
        return refuse(f"--seed must not be negative, got {options.seed}")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        warm_up()
        study(options.out, searched() if options.fit else FITTED, options.runs, options.seed)
    except OSError as error:
        return refuse(f"cannot write to {options.out}: {error.strerror or error}")
    except KeyboardInterrupt:
        return refuse("stopped")
    return 0


def refuse(reason: str) -> int:
    """Report in one line what the user must change."""
    print(f"study: {reason}", file=sys.stderr)
    return 2


def searched() -> dict[str, Fit]:
    """The best geometry of every reading, searched again and printed beside what is stored."""
    fits = {}
    for reading in READINGS:
        steps = tqdm(search(reading), total=TRIES + REFINED, desc=reading.name, disable=quiet())
        for fit in steps:
            fits[reading.name] = fit
        print(f"{reading.name}, seed {SEED}: {described(fits[reading.name])}")
        print(f"{' stored':>{len(reading.name)}}: {described(FITTED[reading.name])}", flush=True)
    return fits


def described(fit: Fit) -> str:
    """Place and RMS in a line."""
    x, y, z, tilt, turn = fit.place.parameters
    return f"({x:.5f}, {y:.5f}, {z:.5f}) mm, tilt {tilt:.4f}, turn {turn:.4f} deg, RMS {fit.rms_mm:.5f} mm"


def quiet() -> bool:
    """Whether nobody is there to watch a progress bar."""
    return not sys.stderr.isatty()


def study(out: Path, fits: dict[str, Fit], runs: int, seed: int) -> None:
    """Compute all, write all, and print the tables."""
    fit = next(iter(fits.values()))
    with tqdm(total=len(SCENARIOS) + 9, desc="study", disable=quiet()) as progress:
        table: list[Row] = []
        for row in rows(fit, runs, seed):
            table.append(row)
            progress.update()
        curves = other_figures.snr_curves(fit)
        progress.update()
        pictures = {}
        for name, draw in figures_of(fit, table, curves).items():
            pictures[name] = save(draw(), out / name)
            progress.update()
    tables = tables_of(fits, table)
    for name, (columns, lines) in tables.items():
        write_csv(out / f"{name}.csv", columns, lines)
        print(f"\n{name}\n{plain(columns, lines)}")
    write_csv(out / "figure_12.csv", CURVE_COLUMNS, [curve_line(curve) for curve in curves])
    (out / "study.html").write_text(study_page(pictures, tables, fit, table), encoding="utf-8")
    print(
        f"\nwritten to {out}: study.html, {len(pictures)} figures (PNG, SVG), {len(tables) + 1} tables (CSV)"
    )


def figures_of(fit: Fit, table: list[Row], curves: list[Curve]) -> dict[str, Callable[[], Any]]:
    """What draws each figure, by the name of its file."""
    return {
        "figure_9a": lambda: cloud_figures.figure_9a(fit),
        "figure_9b": lambda: other_figures.figure_9b(fit),
        "figure_10": lambda: cloud_figures.figure_10(fit),
        "figure_11": lambda: cloud_figures.figure_11(fit),
        "figure_12": lambda: other_figures.figure_12(curves),
        "table_4": lambda: other_figures.figure_table_4(table),
        "runs": lambda: other_figures.figure_runs(table),
        "sensitivity": lambda: other_figures.figure_sensitivity(fit),
    }


def tables_of(fits: dict[str, Fit], table: list[Row]) -> dict[str, Table]:
    """Every table, by the name of its file."""
    return {
        "table_3": (TABLE_3_COLUMNS, TABLE_3),
        "table_4": (COLUMNS, list(cells(table))),
        "runs": (RUN_COLUMNS, [run_line(row) for row in table]),
        "geometry": (FIT_COLUMNS, [fit_line(name, fit) for name, fit in fits.items()]),
        "consistency": (Check._fields, checks(next(iter(fits.values())))),
    }


RUN_COLUMNS = (
    "scenario", "measured", "refused", "unbounded_worst_case",
    "mean_mm", "std_mm", "held_by_paper_percent", "held_by_worst_case_percent",
)  # fmt: skip


def run_line(row: Row) -> tuple[object, ...]:
    """The simulated runs of a row as RUN_COLUMNS."""
    runs, errors = row.runs, row.runs.errors_mm
    return (
        row.scenario.number, len(errors), runs.refused, runs.unbounded,
        float(errors.mean()), float(errors.std(ddof=1)), 100 * runs.held_paper, 100 * runs.held_worst_case,
    )  # fmt: skip


FIT_COLUMNS = (
    "reading",
    "x_mm",
    "y_mm",
    "z_mm",
    "tilt_deg",
    "turn_deg",
    "rms_rows_1_5_mm",
    "rms_rows_1_6_mm",
)


def fit_line(name: str, fit: Fit) -> tuple[object, ...]:
    """A geometry as FIT_COLUMNS."""
    return name, *fit.place.parameters, *(rms_mm(fit.place, fit.apex, count) for count in (5, 6))


CURVE_COLUMNS = ("errors", "interval", "apex", "travel_mm", "gap_min_mm", "gap_max_mm", "snr")


def curve_line(curve: Curve) -> tuple[object, ...]:
    """A point of figure 12 as CURVE_COLUMNS."""
    return (*curve[:4], curve.range.gap_min * 1e3, curve.range.gap_max * 1e3, curve.range.snr)


if __name__ == "__main__":
    sys.exit(main())
