"""Plot of a recording: gap, bounds, truth and signal-to-noise ratio over time."""

from pathlib import Path

import matplotlib
import numpy as np

from knee_gap_replay.report.comparison import Comparison

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # the backend must be chosen first

BLUE, ORANGE, GREY = "#1f4e8c", "#d1651a", "#6b6b6b"


def write_gap_plot(comparison: Comparison, path: Path, title: str) -> None:
    """Write the plot as PNG. Only valid estimates are drawn; elsewhere the band is empty."""
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(10, 6.2), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    time = comparison.time

    def valid(values: "np.typing.NDArray[np.float64]") -> "np.typing.NDArray[np.float64]":
        return 1e3 * np.where(comparison.valid, values, np.nan)

    low, high = valid(comparison.gap_min), valid(comparison.gap_max)
    top.fill_between(time, low, high, color=BLUE, alpha=0.15, lw=0, label="[min, max], worst case")
    confident = valid(comparison.confidence_min), valid(comparison.confidence_max)
    if np.isfinite(confident[0]).any():
        top.fill_between(time, *confident, color=BLUE, alpha=0.35, lw=0, label="95 % interval, all views")
    top.plot(time, valid(comparison.gap), color=BLUE, lw=1.5, label="gap")
    top.plot(time, 1e3 * comparison.truth, color=ORANGE, lw=1.5, ls="--", label="truth")
    top.set_ylabel("gap [mm]")
    limit = 2.5 * 1e3 * np.nanmedian(comparison.truth) if np.isfinite(comparison.truth).any() else 10.0
    top.set_ylim(0.0, limit)
    top.legend(loc="upper right", ncols=4, frameon=False)
    top.set_title(title, loc="left", fontsize=11)

    bottom.plot(time, np.where(comparison.valid, comparison.snr, np.nan), color=BLUE, lw=1.5)
    bottom.set_ylabel("SNR [-]")
    bottom.set_ylim(bottom=0.0)
    bottom.set_xlabel("time [s]")
    travel = bottom.twinx()
    travel.plot(time, 1e3 * comparison.baseline, color=GREY, lw=1.0, ls=":")
    travel.set_ylabel("baseline [mm]", color=GREY)
    travel.set_ylim(bottom=0.0)
    for axes in (top, bottom):
        axes.grid(color="#dddddd", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    travel.spines["top"].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
