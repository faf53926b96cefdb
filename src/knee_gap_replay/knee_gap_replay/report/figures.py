"""Figures of a report as SVG: gap, status, signal-to-noise ratio and baseline over time; shares; all bags."""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_replay.report.results import Floats, Results, status_name
from knee_gap_uncertainty.estimation.messages import SHARES

mpl.use("Agg")

import matplotlib.pyplot as plt  # the backend must be chosen first
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, ORANGE, GREY = "#1f4e8c", "#d1651a", "#6b6b6b"
STATUS_COLOURS = {
    GapStatus.VALID: "#4b9f5a",
    GapStatus.UNKNOWN: "#9a9a9a",
    GapStatus.NO_EDGES: "#d1651a",
    GapStatus.TRACKING_LOST: "#b3261e",
    GapStatus.INSUFFICIENT_PARALLAX: "#e2b93b",
    GapStatus.OUT_OF_SYNC: "#7b4fa3",
    GapStatus.JOINT_MOVED: "#2a9d9d",
}
SHARE_COLOURS = ("#1f4e8c", "#2a9d9d", "#7cc0a0", "#9a9a9a", "#d1651a", "#e2b93b")
# With more points than this the curves are drawn as a picture inside the SVG: vectors would take megabytes.
_MOST_VECTOR_POINTS = 5000
# The same figure has the same bytes, and its fonts are those of the page.
_SVG: dict[Any, Any] = {
    "svg.hashsalt": "knee_gap",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9,
}
# Ranges that one thing far out must not spoil: of the drawn bounds, this fraction is inside.
_SHOWN = 0.98


def over_time(results: Results, truth: Floats) -> str:
    """Gap with bounds, interval and truth; status of every image; signal-to-noise ratio and baseline."""
    with mpl.rc_context(_SVG):
        figure, (top, strip, bottom) = plt.subplots(
            3, 1, figsize=(10, 6.6), sharex=True, height_ratios=(3, 0.16, 1.1), layout="constrained"
        )
        _draw_gap(top, results, truth)
        _draw_status(strip, results)
        _draw_snr(bottom, results)
        for axes in (top, bottom):
            axes.grid(color="#dddddd", lw=0.6)
            axes.spines[["top", "right"]].set_visible(False)
        bottom.set_xlim(0.0, max(results.duration, 1e-3))
        return _svg(figure)


def error_budget(results: Results) -> str:
    """Shares of the gap's variance by cause over time, stacked; empty if none is known."""
    time, shares = _in_order(results, [results.numbers[name] for name in SHARES])
    if not np.isfinite(shares).any():
        return ""
    with mpl.rc_context(_SVG):
        figure, axes = plt.subplots(figsize=(10, 2.6), layout="constrained")
        low = np.zeros(len(time))
        for name, colour, share in zip(SHARES, SHARE_COLOURS, shares, strict=True):
            axes.fill_between(
                time,
                100 * low,
                100 * (low + share),
                color=colour,
                lw=0,
                label=name.removeprefix("share_").replace("_", " "),
                rasterized=_is_long(time),
            )
            low = low + share
        axes.set(ylabel="share of variance [%]", xlabel="time [s]", ylim=(0, 100))
        axes.set_xlim(0.0, max(results.duration, 1e-3))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.22), ncols=6, frameon=False)
        return _svg(figure)


def all_bags(names: Sequence[str], reports: Sequence[tuple[Results, Floats]]) -> str:
    """Median gap, bounds and truth of every bag, and the fraction of estimates that are VALID."""
    with mpl.rc_context(_SVG):
        height = 0.9 + 0.28 * len(names)
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(10, height), sharey=True, width_ratios=(3, 1), layout="constrained"
        )
        rows = np.arange(len(names))
        for row, (results, truth) in zip(rows, reports, strict=True):
            low, gap, high = (1e3 * results.median(results.numbers[k]) for k in ("gap_min", "gap", "gap_max"))
            if np.isfinite([low, high]).all():
                left.plot([low, high], [row, row], color=BLUE, alpha=0.3, lw=6, solid_capstyle="butt")
            left.plot(gap, row, "o", color=BLUE, ms=5)
            left.plot(1e3 * results.median(truth), row, "d", color=ORANGE, ms=5)
            right.barh(row, 100 * results.valid_share, color=STATUS_COLOURS[GapStatus.VALID], height=0.5)
        left.set_yticks(rows, names)
        left.set_ylim(len(names) - 0.5, -0.5)
        left.set_xlabel("median gap and bounds [mm]; diamond: truth")
        left.set_xlim(left=0.0)
        right.set(xlabel="VALID [%]", xlim=(0, 100))
        for axes in (left, right):
            axes.grid(axis="x", color="#dddddd", lw=0.6)
            axes.spines[["top", "right"]].set_visible(False)
        return _svg(figure)


def _draw_gap(axes: Axes, results: Results, truth: Floats) -> None:
    numbers, valid = results.numbers, results.valid

    def in_mm(name: str) -> Floats:
        return 1e3 * np.where(valid, numbers[name], np.nan)

    names = ("gap_min", "gap_max", "confidence_min", "confidence_max", "gap")
    time, (low, high, least, most, gap) = _in_order(results, [in_mm(name) for name in names])
    is_long = _is_long(time)
    axes.fill_between(time, low, high, color=BLUE, alpha=0.15, lw=0, label="[min, max]", rasterized=is_long)
    if np.isfinite(least).any():
        axes.fill_between(
            time, least, most, color=BLUE, alpha=0.35, lw=0, label="confidence interval", rasterized=is_long
        )
    # Between others that are not VALID, one estimate makes neither a line nor a band.
    alone = np.isfinite(gap) & np.isnan(np.roll(gap, 1)) & np.isnan(np.roll(gap, -1))
    axes.vlines(time[alone], low[alone], high[alone], color=BLUE, alpha=0.3, lw=1.5, rasterized=is_long)
    axes.plot(time, gap, ".-", color=BLUE, lw=1.4, ms=2, label="gap", rasterized=is_long)
    known = np.isfinite(truth) & np.isfinite(results.time)
    if known.any():
        axes.plot(results.time[known], 1e3 * truth[known], ".", color=ORANGE, ms=4, label="truth")
    drawn = np.concatenate([high[np.isfinite(high)], 1e3 * truth[known]])
    axes.set_ylim(0.0, 1.15 * float(np.quantile(drawn, _SHOWN)) if drawn.size else 10.0)
    axes.set_ylabel("gap [mm]")
    if not valid.any():
        axes.text(0.5, 0.5, "no VALID estimate", transform=axes.transAxes, ha="center", color=GREY)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=4, frameon=False)


def _draw_status(axes: Axes, results: Results) -> None:
    """A strip with the colour of each image's status."""
    known = np.flatnonzero(np.isfinite(results.time))
    known = known[np.argsort(results.time[known], kind="stable")]
    status = results.status[known]
    edges = np.flatnonzero(np.diff(status, prepend=-1))
    begins = results.time[known][edges]
    ends = np.append(begins[1:], results.time[known][-1]) if begins.size else begins
    for value in sorted(set(status.tolist())):
        spans = [
            (float(begin), float(end - begin))
            for begin, end, index in zip(begins, ends, edges, strict=True)
            if status[index] == value
        ]
        colour = STATUS_COLOURS.get(value, "#000000")
        axes.broken_barh(spans, (0, 1), color=colour, lw=0, rasterized=len(spans) > 1000)
        axes.plot([], [], "s", color=colour, label=status_name(value))
    axes.set(ylim=(0, 1), yticks=[])
    axes.spines[:].set_visible(False)
    axes.tick_params(bottom=False)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=7, frameon=False, fontsize=8)


def _draw_snr(axes: Axes, results: Results) -> None:
    snr = np.where(results.valid, results.numbers["snr"], np.nan)
    time, (snr, baseline) = _in_order(results, [snr, results.numbers["baseline"]])
    axes.plot(time, snr, ".-", color=BLUE, lw=1.4, ms=2, rasterized=_is_long(time))
    axes.set(ylabel="SNR [-]", xlabel="time [s]")
    axes.set_ylim(bottom=0.0)
    beside = axes.twinx()
    beside.plot(time, 1e3 * baseline, color=GREY, lw=1.0, ls=":", rasterized=_is_long(time))
    beside.set_ylabel("baseline [mm]", color=GREY)
    beside.set_ylim(bottom=0.0)
    beside.spines["top"].set_visible(False)


def _in_order(results: Results, columns: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Times (n,) in order, and columns (k, n) with them; estimates of another clock are left out."""
    known = np.flatnonzero(np.isfinite(results.time))
    known = known[np.argsort(results.time[known], kind="stable")]
    return results.time[known], np.array([column[known] for column in columns])


def _is_long(time: npt.NDArray[np.float64]) -> bool:
    return len(time) > _MOST_VECTOR_POINTS


def _svg(figure: Figure) -> str:
    """The figure as an SVG element, as wide as the page allows; the figure is closed."""
    file = io.StringIO()
    figure.savefig(file, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = file.getvalue()
    element = text[text.index("<svg") :]
    # No metadata: they name addresses, though nothing would be fetched from them.
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    return re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', 'width="100%"', element, count=1)
