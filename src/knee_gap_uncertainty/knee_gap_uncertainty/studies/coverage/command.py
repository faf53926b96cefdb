"""`coverage`: how often the intervals hold the truth, cell by cell, as a table (CSV) and a plot."""

import os
import random
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_core.user_files import FileError
from knee_gap_uncertainty.multi_view import maximum_likelihood as multi_view
from knee_gap_uncertainty.studies.coverage.cells import cells
from knee_gap_uncertainty.studies.coverage.measure import batches, measure
from knee_gap_uncertainty.studies.coverage.plot import save_plot
from knee_gap_uncertainty.studies.coverage.table import Row, summary, write_csv
from knee_gap_uncertainty.studies.coverage.unfinished import Unfinished
from knee_gap_uncertainty.two_view import gap_range

DEFAULT_RUNS = 100
FULL_RUNS = 3000
MOST_RUNS = 100_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; 0 when all was written, 2 for a user's mistake."""
    parser = Parser(prog="coverage", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("out/coverage"), help="where to write (out/coverage)"
    )
    parser.add_argument(
        "--runs",
        type=int,
        default=DEFAULT_RUNS,
        help=f"simulated tracks of each cell ({DEFAULT_RUNS}: a look; {FULL_RUNS}: coverage to 0.4 %%)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the tracks (1)")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="cores to use (all)")
    parser.add_argument(
        "--so-far", action="store_true", help="table, plot and summary of what an interrupted run finished"
    )
    options = parser.parse_args(argv)
    if not 10 <= options.runs <= MOST_RUNS:
        return refuse(f"--runs must be from 10 to {MOST_RUNS}, got {options.runs}")
    if options.seed < 0:
        return refuse(f"--seed must not be negative, got {options.seed}")
    if options.processes < 1:
        return refuse(f"--processes must be at least 1, got {options.processes}")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        unfinished = Unfinished(options.out, options.runs, options.seed)
        if options.so_far:
            done = unfinished.read()
            if not done:
                return refuse(f"nothing was begun in {options.out} with these --runs and --seed")
            rows = with_ranges([row for number in sorted(done) for row in done[number]])
        else:
            rows = with_ranges(study(options.runs, options.seed, options.processes, unfinished))
        write_csv(options.out / "coverage.csv", rows)
        save_plot(options.out / "coverage.png", rows)
        if not options.so_far:
            unfinished.remove()
    except FileError as error:
        return refuse(str(error))
    except OSError as error:
        return refuse(f"cannot write to {options.out}: {error.strerror or error}")
    except KeyboardInterrupt:
        return refuse("stopped; the same command goes on from here")
    of_all = f" of {sum(1 for _ in cells())}" if options.so_far else ""
    print(f"{len(rows)}{of_all} cells, {options.runs} runs each, seed {options.seed}")
    print("\n".join(summary(rows)))
    print(f"written: {options.out / 'coverage.csv'}, {options.out / 'coverage.png'}")
    return 0


def refuse(reason: str) -> int:
    """Report in one line what the user must change."""
    print(f"coverage: {reason}", file=sys.stderr)
    return 2


def study(runs: int, seed: int, processes: int, unfinished: Unfinished) -> list[Row]:
    """All rows, in the order of the cells whichever process finished first."""
    # Compiled once, before the processes that would all compile at the same time.
    multi_view.warm_up()
    gap_range.warm_up()
    found = unfinished.read()
    todo = [batch for batch in batches() if batch.number not in found]
    if todo:
        measure(todo[0], 10, seed)
    # In no order, so that what is done of an interrupted study is a fair sample of it.
    random.Random(seed).shuffle(todo)
    with ProcessPoolExecutor(processes) as pool:
        futures = {pool.submit(measure, batch, runs, seed): batch for batch in todo}
        for future in _with_progress(as_completed(futures), len(todo)):
            number = futures[future].number
            found[number] = future.result()
            unfinished.add(number, found[number])
    return [row for number in sorted(found) for row in found[number]]


def _with_progress(finished: Iterable, total: int) -> Iterator:  # type: ignore[type-arg]
    if sys.stderr.isatty():
        yield from tqdm(finished, total=total, desc="coverage", unit="batch")
        return
    printed = 0
    for count, future in enumerate(finished, start=1):
        if 10 * count // total > printed:
            printed = 10 * count // total
            print(f"coverage: {10 * printed} %", file=sys.stderr, flush=True)
        yield future


def with_ranges(rows: Sequence[Row]) -> list[Row]:
    """Rows with the widths of the ranges beside them also where more views lie between the first and last."""
    keys = ("depth_mm", "gap_mm", "travel_mm", "direction_deg", "errors", "share", "noise")
    ranges = ("worst_case_coverage", "worst_case_width_mm", "paper_coverage", "paper_width_mm")
    of_two = {
        tuple(getattr(row, key) for key in keys): {name: getattr(row, name) for name in ranges}
        for row in rows
        if row.views == 2 and row.model == "right"
    }
    return [replace(row, **of_two.get(tuple(getattr(row, key) for key in keys), {})) for row in rows]


if __name__ == "__main__":
    sys.exit(main())
