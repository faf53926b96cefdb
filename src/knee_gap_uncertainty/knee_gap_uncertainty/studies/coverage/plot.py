"""The picture of the study: coverage of every cell, and widths beside the paper's range."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from knee_gap_uncertainty.studies.coverage.table import PROMISED, Row

mpl.use("Agg")
from matplotlib import pyplot as plt  # the backend has to be chosen before
from matplotlib.axes import Axes

COLOURS = {2: "#b5651d", 10: "#2a7fba", 60: "#1b3a5c"}


def save_plot(path: Path, rows: Sequence[Row]) -> None:
    """Draw the rows of the right model and write a PNG."""
    right = [row for row in rows if row.model == "right" and row.accepted > 0.0]
    figure, (left, middle, rightmost) = plt.subplots(1, 3, figsize=(15, 4.8), layout="constrained")
    _draw_coverage(left, right)
    _draw_distribution(middle, right)
    _draw_widths(rightmost, right)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_coverage(axes: Axes, rows: Sequence[Row]) -> None:
    axes.axhspan(100 * PROMISED[0], 100 * PROMISED[1], color="#dfe9df", zorder=0)
    axes.axvline(90, color="grey", linewidth=0.8, linestyle=":")
    for views, colour in COLOURS.items():
        those = [row for row in rows if row.views == views]
        axes.plot(
            [100 * row.accepted for row in those],
            [100 * row.coverage for row in those],
            ".",
            color=colour,
            markersize=4,
            alpha=0.6,
            label=f"N = {views}",
        )
    axes.set(xlabel="runs accepted [%]", ylabel="coverage of the accepted [%]", ylim=(80, 100.5))
    axes.set_title("Nominal 95 % interval, right model")
    axes.legend(loc="lower left")


def _draw_distribution(axes: Axes, rows: Sequence[Row]) -> None:
    promised = [row for row in rows if row.promised]
    bounded = [row for row in rows if row.views == 2 and row.noise == "bounded"]
    series = {
        "95 % interval, >= 90 % accepted": ([row.coverage for row in promised], "#2a7fba"),
        "worst_case, bounded noise": ([row.worst_case_coverage for row in bounded], "#3a7d44"),
        "paper's range, bounded noise": ([row.paper_coverage for row in bounded], "#a23b3b"),
    }
    for label, (values, colour) in series.items():
        known = np.sort([value for value in values if np.isfinite(value)])
        if len(known):
            axes.step(100 * known, np.arange(1, len(known) + 1) / len(known), color=colour, label=label)
    axes.axvline(95, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlabel="coverage of a cell [%]", ylabel="share of the cells with at most that", xlim=(0, 101))
    axes.set_title("How often the truth is inside")
    axes.legend(loc="upper left")


def _draw_widths(axes: Axes, rows: Sequence[Row]) -> None:
    paper = {_tracks(row): row.paper_width_mm for row in rows if row.views == 2}
    for views, colour in COLOURS.items():
        those = [row for row in rows if row.views == views and row.promised and _tracks(row) in paper]
        axes.loglog(
            [paper[_tracks(row)] for row in those],
            [row.width_mm for row in those],
            ".",
            color=colour,
            markersize=4,
            alpha=0.6,
            label=f"95 % interval, N = {views}",
        )
    two = [row for row in rows if row.views == 2 and row.promised]
    axes.loglog(
        [row.paper_width_mm for row in two],
        [row.worst_case_width_mm for row in two],
        "x",
        color="#3a7d44",
        markersize=3,
        alpha=0.5,
        label="worst_case",
    )
    ends = np.array([0.05, 20.0])
    axes.loglog(ends, ends, color="grey", linewidth=0.8)
    axes.set(xlabel="median width of the paper's range [mm]", ylabel="median width [mm]")
    axes.set_title("Widths where >= 90 % are accepted")
    axes.legend(loc="upper left", fontsize=8)


def _tracks(row: Row) -> tuple[object, ...]:
    """What two cells share whose ranges, from the first and the last view, are alike."""
    return (
        row.depth_mm,
        row.gap_mm,
        row.travel_mm,
        row.direction_deg,
        row.errors,
        row.share,
        row.noise,
    )
