"""The table of the study: one row a cell, what was measured in it, and how it reads in a few lines."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from math import nan
from pathlib import Path

import numpy as np

from knee_gap_uncertainty.studies.coverage.cells import MODELS

PROMISED = (0.93, 0.97)
MOSTLY_ACCEPTED = 0.9
PROMISED_WORST_CASE = 0.999
SMALL_DEPTH_ERROR = 0.1


@dataclass(frozen=True)
class Row:
    """One cell; lengths in millimetres, shares and chances from 0 to 1, NaN if not known.

    `coverage` and what follows it to `bias_mm` are of the accepted runs. `missed_below`: the gap was below
    the interval. `width_mm` is a median, as are those of the ranges. `refused_lower_coverage`: how often the
    lower bound held in the refused runs. `variance_ratio`: variance of the estimate over the least possible
    where the common offset is not estimated; `variance_ratio_constant_offset` over the least possible where
    it is. The ranges are those of the first and the last view, measured in the cells of two views.
    """

    depth_mm: float
    gap_mm: float
    travel_mm: float
    direction_deg: int
    errors: str
    views: int
    share: str
    noise: str
    model: str
    runs: int
    accepted: float
    coverage: float
    missed_below: float
    missed_above: float
    unbounded: float
    width_mm: float
    bias_mm: float
    refused_lower_coverage: float
    inverse_depth_variation: float
    depth_error_over_gap: float
    variance_ratio: float
    variance_ratio_constant_offset: float
    worst_case_coverage: float = nan
    worst_case_width_mm: float = nan
    paper_coverage: float = nan
    paper_width_mm: float = nan

    @property
    def promised(self) -> bool:
        """Whether the level is promised in this cell."""
        return self.model == "right" and self.accepted >= MOSTLY_ACCEPTED


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write the table, numbers to six digits."""
    names = [field.name for field in fields(Row)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for row in rows:
            values = asdict(row)
            writer.writerow([_plain(values[name]) for name in names])


def _plain(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def summary(rows: Sequence[Row]) -> list[str]:
    """A summary of the table, in lines; cells outside of what is promised are counted and named."""
    promised = [row for row in rows if row.promised]
    lines = [_coverage_line(f"{len(promised)} cells of the right model, >= 90 % accepted", promised)]
    outside = [row for row in promised if not PROMISED[0] <= row.coverage <= PROMISED[1]]
    lines.append(
        f"  outside 93-97 %: {len(outside)}" + "".join(f"\n    {_named(row)}" for row in outside[:10])
    )
    for views in sorted({row.views for row in promised}):
        for share in ("independent", "half", "common"):
            those = [row for row in promised if row.views == views and row.share == share]
            lines.append(_coverage_line(f"  N = {views}, {share}: {len(those)} cells", those))
    for model in MODELS[1:]:
        wrong = [row for row in rows if row.model == model and row.accepted >= MOSTLY_ACCEPTED]
        for few, those in (
            ("N = 2", [row for row in wrong if row.views == 2]),
            ("N >= 10", [row for row in wrong if row.views >= 10]),
        ):
            lines.append(_coverage_line(f"wrong model, {model}, {few}: {len(those)} cells", those))
    seldom = [row for row in rows if row.model == "right" and 0.05 <= row.accepted < MOSTLY_ACCEPTED]
    lines.append(_coverage_line(f"{len(seldom)} cells with 5-90 % accepted", seldom))
    lines.extend(_range_lines(rows))
    lines.extend(_variance_lines(rows))
    return lines


def _coverage_line(name: str, rows: Sequence[Row]) -> str:
    if not rows:
        return f"{name}: none"
    values = np.array([row.coverage for row in rows])
    return (
        f"{name}: coverage {100 * values.mean():.2f} % (least {100 * values.min():.2f}, "
        f"most {100 * values.max():.2f}, deviation between cells {100 * values.std():.2f})"
    )


def _named(row: Row) -> str:
    return (
        f"{100 * row.coverage:.2f} %: depth {row.depth_mm:g}, gap {row.gap_mm:g}, "
        f"travel {row.travel_mm:g} mm at {row.direction_deg} deg, {row.errors}, N = {row.views}, "
        f"{row.share}, {row.noise}, {100 * row.accepted:.1f} % accepted"
    )


def _range_lines(rows: Sequence[Row]) -> list[str]:
    right = [row for row in rows if row.model == "right" and row.noise == "bounded" and row.views == 2]
    finite = [row for row in right if not np.isnan(row.worst_case_coverage)]
    lines = []
    if finite:
        least = min(row.worst_case_coverage for row in finite)
        below = sum(row.worst_case_coverage < PROMISED_WORST_CASE for row in finite)
        lines.append(
            f"worst_case under bounded noise: least coverage {100 * least:.2f} % in {len(finite)} cells; "
            f"below 99.9 %: {below}"
        )
        paper = np.array([row.paper_coverage for row in finite])
        lines.append(
            f"paper's range under bounded noise: median coverage {100 * np.nanmedian(paper):.1f} %, "
            f"least {100 * np.nanmin(paper):.1f} %"
        )
    for views in sorted({row.views for row in rows}):
        those = [row for row in rows if row.promised and row.views == views and row.paper_width_mm > 0.0]
        if those:
            ratio = np.median([row.width_mm / row.paper_width_mm for row in those])
            lines.append(f"N = {views}: median width of the interval is {ratio:.2f} of the paper's range")
    return lines


def _variance_lines(rows: Sequence[Row]) -> list[str]:
    lines = []
    for low, high in ((0.0, SMALL_DEPTH_ERROR), (SMALL_DEPTH_ERROR, 0.25), (0.25, 0.5), (0.5, np.inf)):
        those = [row for row in rows if row.promised and low <= row.depth_error_over_gap < high]
        if not those:
            continue
        ratio = np.array([row.variance_ratio for row in those])
        constant = np.array([row.variance_ratio_constant_offset for row in those])
        bias = np.array([row.bias_mm / row.gap_mm for row in those])
        lines.append(
            f"sigma_z / d {low:g}-{high:g}: variance over the bound median {np.median(ratio):.3f}, most "
            f"{ratio.max():.3f}; over the bound for a constant offset median {np.nanmedian(constant):.3f}; "
            f"bias / gap median {100 * np.median(bias):.2f} %, most {100 * np.abs(bias).max():.1f} %"
        )
    return lines
