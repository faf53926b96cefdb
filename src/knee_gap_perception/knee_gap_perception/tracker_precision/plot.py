"""Plot of the tracker's precision: segments at rest and in motion, and each pose's error."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.tracker_precision.precision import ErrorSums, Precision

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

REST, MOTION = "tab:blue", "tab:orange"


def plot(precisions: Sequence[Precision], path: Path) -> None:
    """Draw the path and the errors of each recording into a PNG."""
    figure, axes = plt.subplots(
        3, len(precisions), figsize=(max(7.0, 5.0 * len(precisions)), 8.0), squeeze=False, sharex="col"
    )
    for column, precision in zip(axes.T, precisions, strict=True):
        time, errors = precision.series.time, precision
        centred = (precision.series.position - np.median(precision.series.position, axis=0)) * 1e3
        for axis, label in enumerate("xyz"):
            column[0].plot(time, centred[:, axis], linewidth=0.8, label=label)
        column[0].set(title=precision.series.name, ylabel="position (mm)")
        column[0].legend(loc="upper right", ncols=3, fontsize="small")
        _errors(
            column[1], precision, errors.position_error * 1e3, precision.position, 1e3, "position error (mm)"
        )
        scale = float(np.degrees(1.0))
        _errors(
            column[2],
            precision,
            errors.rotation_error * scale,
            precision.rotation,
            scale,
            "rotation error (deg)",
        )
        column[2].set_xlabel("time (s)")
        for axis_ in column:
            _shade(axis_, precision)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _errors(
    axes: Axes, precision: Precision, errors: Array, sums: ErrorSums, scale: float, label: str
) -> None:
    lengths = np.linalg.norm(errors, axis=1)
    kept = np.zeros(len(lengths), dtype=bool)
    for segment in precision.segments:
        kept[segment.start : segment.stop] = True
    axes.plot(precision.series.time[kept], lengths[kept], ".", markersize=1.5, color="0.35")
    for name, value, colour in (
        ("at rest", sums.rest.rms, REST),
        ("in motion, slow part included", sums.motion, MOTION),
    ):
        if np.isfinite(value):
            axes.axhline(value * scale, color=colour, label=f"RMS {name} {value * scale:.4f}")
    axes.set_ylabel(label)
    if kept.any():
        axes.set_ylim(0.0, 1.2 * float(np.nanquantile(lengths[kept], 0.999)))
    axes.legend(loc="upper right", fontsize="small")


def _shade(axes: Axes, precision: Precision) -> None:
    for segment in precision.segments:
        first, last = precision.series.time[segment.start], precision.series.time[segment.stop - 1]
        axes.axvspan(first, last, color=REST if segment.at_rest else MOTION, alpha=0.1, linewidth=0)
