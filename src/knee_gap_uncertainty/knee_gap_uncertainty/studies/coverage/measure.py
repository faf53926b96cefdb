"""Measurement of a cell: simulate its tracks, run the estimator on them, and count."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import MeasurementError
from knee_gap_uncertainty.studies.coverage.bound import bound
from knee_gap_uncertainty.studies.coverage.cells import Cell, cells
from knee_gap_uncertainty.studies.coverage.intervals import intervals
from knee_gap_uncertainty.studies.coverage.table import Row
from knee_gap_uncertainty.studies.coverage.tracks import Tracks, simulate
from knee_gap_uncertainty.two_view.angle_sets import Interval
from knee_gap_uncertainty.two_view.gap_range import gap_range

# Runs behind a median width, and behind the coverage of the paper's range; worst_case is run on every track.
RUNS_OF_WIDTHS = 300


class Batch(NamedTuple):
    """Cells on the same tracks, which differ only in what the estimator assumes; `number` seeds them."""

    number: int
    cells: tuple[Cell, ...]


def batches() -> Iterator[Batch]:
    """All cells, those on the same tracks together."""
    same = groupby(cells(), key=lambda cell: replace(cell, model="right"))
    for number, (_, group) in enumerate(same):
        yield Batch(number, tuple(group))


def measure(batch: Batch, runs: int, seed: int) -> list[Row]:
    """Rows of a batch from `runs` tracks of its own seed."""
    tracks = simulate(batch.cells[0], runs, np.random.default_rng([seed, batch.number]))
    return [_row(cell, tracks) for cell in batch.cells]


def _row(cell: Cell, tracks: Tracks) -> Row:
    found = intervals(tracks, cell)
    accepted, gap = found.accepted, tracks.gap
    least = bound(cell)
    row = Row(
        depth_mm=1e3 * cell.scene.depth,
        gap_mm=1e3 * gap,
        travel_mm=1e3 * cell.scene.travel,
        direction_deg=cell.scene.direction_deg,
        errors=cell.errors.name,
        views=cell.view_count,
        share=cell.share,
        noise=cell.noise,
        model=cell.model,
        runs=len(accepted),
        accepted=float(accepted.mean()),
        coverage=_mean((found.lower <= gap) & (gap <= found.upper), accepted),
        missed_below=_mean(gap < found.lower, accepted),
        missed_above=_mean(gap > found.upper, accepted),
        unbounded=_mean(np.isinf(found.upper), accepted),
        width_mm=1e3 * _median((found.upper - found.lower)[accepted]),
        bias_mm=1e3 * _mean(found.gap - gap, accepted),
        refused_lower_coverage=_mean(found.lower <= gap, ~accepted),
        inverse_depth_variation=_median(found.variation),
        depth_error_over_gap=least.depth / gap,
        variance_ratio=_variance(found.gap[accepted]) / least.gap_considered**2,
        variance_ratio_constant_offset=_variance(found.gap[accepted]) / least.gap_offset_known_constant**2,
    )
    if cell.view_count != 2 or cell.model != "right":
        return row
    worst = _ranges(cell, tracks, "worst_case", len(accepted) if cell.noise == "bounded" else RUNS_OF_WIDTHS)
    paper = _ranges(cell, tracks, "paper", RUNS_OF_WIDTHS)
    return replace(
        row,
        worst_case_coverage=_mean((worst[:, 0] <= gap) & (gap <= worst[:, 1]), ~np.isnan(worst[:, 0])),
        worst_case_width_mm=1e3 * _median(worst[:RUNS_OF_WIDTHS, 1] - worst[:RUNS_OF_WIDTHS, 0]),
        paper_coverage=_mean((paper[:, 0] <= gap) & (gap <= paper[:, 1]), ~np.isnan(paper[:, 0])),
        paper_width_mm=1e3 * _median(paper[:, 1] - paper[:, 0]),
    )


def _ranges(cell: Cell, tracks: Tracks, interval: Interval, most: int) -> Array:
    """(R, 2) gap_min and gap_max [m] of the first and last view of up to `most` tracks; NaN where refused."""
    count = min(most, len(tracks.lens))
    found = np.full((count, 2), np.nan)
    for run in range(count):
        try:
            bounds = gap_range(
                tracks.lens[run, 0],
                tracks.lens[run, -1],
                tracks.bearings[run, 0],
                tracks.bearings[run, -1],
                angular_error=cell.errors.image_error + cell.errors.rotation_error,
                translation_error=cell.errors.translation_error,
                interval=interval,
                apex="best",
            )
        except MeasurementError:
            continue
        found[run] = bounds.gap_min, bounds.gap_max
    return found


def _mean(values: Array | npt.NDArray[np.bool_], chosen: npt.NDArray[np.bool_]) -> float:
    return float(np.mean(values[chosen])) if chosen.any() else float("nan")


def _median(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _variance(values: Array) -> float:
    return float(np.var(values, ddof=1)) if len(values) > 1 else float("nan")
