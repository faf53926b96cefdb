"""Plot of a closed loop: opening, estimates with their bounds and the command over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from knee_gap_bringup.closed_loop.loop import Outcome

mpl.use("Agg")

import matplotlib.pyplot as plt  # the backend must be chosen first

BLUE, ORANGE, GREY, RED, GREEN = "#1f4e8c", "#d1651a", "#6b6b6b", "#b3261e", "#4b9f5a"
_PAUSE = 0.2  # [s] without an estimate that breaks a line


def write_plot(outcome: Outcome, path: Path) -> None:
    """Write the plot as PNG."""
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(10, 6), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    settings = outcome.settings
    time, opening, rate = outcome.trace.T
    heard = np.array([(one.time, one.gap, one.gap_min, one.gap_max) for one in outcome.heard]).reshape(-1, 4)
    valid = np.array([one.is_valid for one in outcome.heard], dtype=bool)
    # A line is broken where no estimate is VALID, or none was received.
    heard[~valid, 1:] = np.nan
    pauses = np.flatnonzero(np.diff(heard[:, 0], prepend=0.0) > _PAUSE)
    heard = np.insert(heard, pauses, np.nan, axis=0)
    top.fill_between(
        heard[:, 0], 1e3 * heard[:, 2], 1e3 * heard[:, 3], color=BLUE, alpha=0.2, lw=0, label="[min, max]"
    )
    top.plot(heard[:, 0], 1e3 * heard[:, 1], color=BLUE, lw=1.4, label="gap")
    top.plot(time, 1e3 * opening, color=ORANGE, lw=1.2, ls="--", label="opening of the joint")
    top.axhline(1e3 * settings.leg.instrument_diameter, color=GREEN, lw=1.0, label="instrument")
    top.axhline(1e3 * settings.leg.largest_gap, color=RED, lw=1.0, label="limit")
    for begin, end in outcome.spans[outcome.spans[:, 0] < outcome.end]:
        for axes in (top, bottom):
            axes.axvspan(begin, min(end, outcome.end), color=GREY, alpha=0.15, lw=0)
    if outcome.passed:
        top.axvline(outcome.passed_at, color=GREEN, lw=1.0, ls=":")
    top.set_ylabel("length [mm]")
    top.set_ylim(0.0, 1e3 * settings.leg.largest_gap + 1.0)
    top.legend(loc="upper left", ncols=5, frameon=False)
    what = "" if not outcome.spans.size else " (shaded)"
    top.set_title(
        f"closed loop, seed {settings.seed}, fault: {settings.fault}{what}", loc="left", fontsize=11
    )
    bottom.plot(time, 1e3 * rate, color=GREY, lw=1.2)
    bottom.set(ylabel="command [mm/s]", xlabel="time [s]")
    bottom.set_xlim(0.0, max(outcome.end, 1e-3))
    for axes in (top, bottom):
        axes.grid(color="#dddddd", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
