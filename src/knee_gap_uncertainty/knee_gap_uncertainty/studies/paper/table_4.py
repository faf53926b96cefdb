"""Table 4 again: the paper's cells, ours by its own interval and by the worst case, and the differences."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from knee_gap_uncertainty.studies.paper.geometry import Fit, exact_views
from knee_gap_uncertainty.studies.paper.monte_carlo import Runs, measured, simulate
from knee_gap_uncertainty.studies.paper.scenarios import (
    SCENARIOS,
    TABLE_4,
    TABLE_4_AVERAGE,
    Published,
    Scenario,
)
from knee_gap_uncertainty.two_view.gap_range import GapRange


@dataclass(frozen=True)
class Row:
    """One scenario: what is printed, our ranges for exact bearings, and the simulated runs."""

    scenario: Scenario
    published: Published
    paper: GapRange
    worst_case: GapRange
    runs: Runs


def rows(fit: Fit, runs: int, seed: int) -> Iterator[Row]:
    """The six rows, each with its own stream of random errors."""
    for scenario in SCENARIOS:
        views = exact_views(fit.place, scenario)
        yield Row(
            scenario,
            TABLE_4[scenario.number],
            measured(views, scenario, fit, "paper"),
            measured(views, scenario, fit, "worst_case"),
            simulate(fit, scenario, runs, np.random.default_rng([seed, scenario.number])),
        )


COLUMNS = (
    "scenario", "set", "angle_deg", "travel_mm", "column",
    "published_mm", "paper_mm", "worst_case_mm", "difference_mm",
)  # fmt: skip


class Cell(NamedTuple):
    """A cell of Table 4 as printed and as found [mm]; NaN where there is no such number."""

    column: str
    published: float
    paper: float
    worst_case: float


def cells(table: list[Row]) -> Iterator[tuple[object, ...]]:
    """One line for each cell of Table 4, as COLUMNS; `difference_mm` is `paper_mm` less `published_mm`.

    Mean and standard deviation are of the simulated runs; they have no interval, and stand under `paper_mm`.
    """
    for row in table:
        scenario = row.scenario
        for cell in cells_of(row):
            yield (
                scenario.number, scenario.parameter_set, scenario.angle_deg, scenario.travel_mm,
                *cell, cell.paper - cell.published,
            )  # fmt: skip
    by_column = zip(*(cells_of(row) for row in table[:4]), strict=True)
    for ours, published in zip(by_column, TABLE_4_AVERAGE, strict=True):
        paper, worst = (float(np.mean([getattr(c, name) for c in ours])) for name in ("paper", "worst_case"))
        yield "average", 1, "", 2.0, ours[0].column, published, paper, worst, paper - published


def cells_of(row: Row) -> list[Cell]:
    """The four cells of a row."""
    mean, std = float(np.mean(row.runs.errors_mm)), float(np.std(row.runs.errors_mm, ddof=1))
    return [
        Cell("minimum", row.published.minimum, row.paper.gap_min * 1e3, row.worst_case.gap_min * 1e3),
        Cell("maximum", row.published.maximum, row.paper.gap_max * 1e3, row.worst_case.gap_max * 1e3),
        Cell("mean", row.published.mean, mean, math.nan),
        Cell("std", row.published.std, std, math.nan),
    ]
