"""Figure 9b, figure 12, Table 4 as a picture, the simulated runs, and how weakly it fixes the geometry."""

import math
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from knee_gap_core.values.errors import MeasurementError
from knee_gap_uncertainty.numerics.vectors import row, vector
from knee_gap_uncertainty.studies.paper.figures.drawing import (
    ACCENT,
    GAP_COLOUR,
    MUTED,
    POINT_COLOURS,
    figure,
)
from knee_gap_uncertainty.studies.paper.geometry import Fit, exact_views
from knee_gap_uncertainty.studies.paper.geometry_fit import sensitivity
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, Scenario, largest_errors, set_1
from knee_gap_uncertainty.studies.paper.table_4 import Row
from knee_gap_uncertainty.two_view.angle_sets import INTERVAL_SIGNS, SIGNS, perturbed_angles
from knee_gap_uncertainty.two_view.gap_range import GapRange, gap_range
from knee_gap_uncertainty.two_view.length_sensitivity import length_bound_linear, length_change, length_error
from knee_gap_uncertainty.two_view.translation_volume import DIRECTIONS
from knee_gap_uncertainty.two_view.triangulation import triangle_angles
from knee_gap_uncertainty.two_view.two_views import TwoViews

TRAVELS_MM = np.arange(1, 81) / 10
INTERVAL_COLOURS = {"paper": "#0b7a8c", "worst_case": "#c8453f"}
APEX_STYLES: dict[str, Any] = {"first": (0, (4, 2)), "second": (0, (1, 1.5)), "best": "-"}
INTERVAL_NAMES = {"paper": "as in the paper", "worst_case": "worst case"}


def length_errors(fit: Fit, scenario: Scenario, n: int, signs: str) -> npt.NDArray[np.float64]:
    """L_error (12) of ray n for all displacements and signs: by (8) and by (11), (cases, 2) [mm]."""
    views = exact_views(fit.place, scenario)
    if fit.apex == "second":
        views = TwoViews(views.lens_1, views.lens_0, views.bearings_1, views.bearings_0)
    own, other = row(views.bearings_0, n), row(views.bearings_1, n)
    angles = triangle_angles(vector(views.travel), own, other)
    length = views.baseline * math.sin(angles[1]) / math.sin(sum(angles))
    errors = []
    shifts = scenario.translation_error * DIRECTIONS
    for pair, start, end in product(SIGNS[signs], shifts, shifts):
        displaced = views.travel + end - start
        perturbed = perturbed_angles(
            triangle_angles(vector(displaced), own, other), pair, scenario.angular_error
        )
        changes = {
            "travel_change": float(np.linalg.norm(displaced)) - views.baseline,
            "own_change": perturbed[0] - angles[0],
            "other_change": perturbed[1] - angles[1],
        }
        errors.append(
            [
                length_error(length, length, change(views.baseline, *angles, **changes)) * 1e3
                for change in (length_change, length_bound_linear)
            ]
        )
    return np.array(errors)


def figure_9b(fit: Fit) -> Any:
    """L_error at 0 degrees, for every pair of displaced lenses, without and with the signs of psi."""
    drawn, grid = figure(2, 1, 11, 4.6)
    titles = {"paper": "Errors of position alone", "worst_case": "With $\\pm\\psi$ in (17) and (18)"}
    for axes, (interval, title) in zip(grid.flat, titles.items(), strict=True):
        for n, colour in enumerate(POINT_COLOURS):
            errors = length_errors(fit, SCENARIOS[0], n, INTERVAL_SIGNS[interval])
            errors = errors[np.argsort(errors[:, 0])]
            step = np.arange(len(errors))
            axes.plot(
                step, errors[:, 1], ".", ms=3.5, mew=0, color=colour, alpha=0.4, label=f"$b_{n}$, linear (11)"
            )
            axes.plot(step, errors[:, 0], "-", lw=2.2, color=colour, label=f"$b_{n}$, exact (8)")
        axes.axhline(0, color=GAP_COLOUR, lw=0.9)
        axes.set_title(title)
        axes.set_xlabel(
            "combinations of displaced lenses" + (" and signs" if interval != "paper" else "") + ", in order"
        )
    grid[0, 0].set_ylabel("$L_{error}$ [mm]")
    handles, names = grid[0, 0].get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside lower center", ncols=4, markerscale=2)
    return drawn


def range_at(fit: Fit, scenario: Scenario, interval: str, apex: str) -> GapRange:
    """Range of a scenario; unknown (NaN, ratio 0) where it is refused."""
    views = exact_views(fit.place, scenario)
    try:
        return gap_range(
            views.lens_0, views.lens_1, views.bearings_0, views.bearings_1,
            angular_error=scenario.angular_error, translation_error=scenario.translation_error,
            interval="paper" if interval == "paper" else "worst_case",
            apex="first" if apex == "first" else "second" if apex == "second" else "best",
        )  # fmt: skip
    except MeasurementError:
        return GapRange(math.nan, math.nan, math.nan, 0.0)


class Curve(NamedTuple):
    """A point of figure 12: which errors, interval and apex, how much travel, and the range found."""

    errors: str
    interval: str
    apex: str
    travel_mm: float
    range: GapRange


def snr_curves(fit: Fit) -> list[Curve]:
    """Figure 12 as numbers."""
    sets = {"set 1, 90°": partial(set_1, 7, 90.0), "set 2, 45°": partial(largest_errors, 7, 2)}
    return [
        Curve(name, interval, apex, travel, range_at(fit, make(travel), interval, apex))
        for (name, make), interval, apex in product(sets.items(), INTERVAL_COLOURS, APEX_STYLES)
        for travel in TRAVELS_MM.tolist()
    ]


def figure_12(curves: list[Curve]) -> Any:
    """Signal-to-noise ratio against travel, and below it the range it stands for."""
    names = list(dict.fromkeys(curve.errors for curve in curves))
    drawn, grid = figure(2, 2, 11, 8, sharex=True)
    for letter, name, (top, bottom) in zip("ab", names, grid.T, strict=True):
        for place, interval in enumerate(("worst_case", "paper")):
            for apex, style in APEX_STYLES.items():
                draw_ratio(top, [c for c in curves if c[:3] == (name, interval, apex)], style, place)
            draw_range(bottom, [c for c in curves if c[:3] == (name, interval, "best")])
        errors, travel = name.split(", ")
        top.set_title(f"({letter})  Errors of {errors}, travel at {travel}")
        top.set(ylim=(0, 1.15 * max(curve.range.snr for curve in curves if curve.errors == name)))
        bottom.axhline(4, color=GAP_COLOUR, lw=1)
        bottom.annotate(
            "true gap", (7.9, 4), xytext=(0, 2), textcoords="offset points", ha="right", fontsize=8.5
        )
        bottom.set(ylim=(0, 12), xlim=(0, 8), xlabel="travel of the lens [mm]")
    grid[0, 0].set_ylabel("gap / (largest - smallest)")
    grid[1, 0].set_ylabel("range of the gap, better of both [mm]")
    ways = {"first": "clouds of $b_n$", "second": "clouds of $a_n$", "best": "better of both"}
    handles = [
        Line2D([], [], color=GAP_COLOUR, ls=APEX_STYLES[apex], label=words) for apex, words in ways.items()
    ]
    handles += [Line2D([], [], color=c, lw=2, label=INTERVAL_NAMES[i]) for i, c in INTERVAL_COLOURS.items()]
    drawn.legend(handles=handles, loc="outside lower center", ncols=5)
    return drawn


def draw_ratio(axes: Any, curve: list[Curve], style: Any, place: int) -> None:
    """One line of the upper panels; for the better apex, with the travel from which on it is bounded."""
    interval, apex = curve[0].interval, curve[0].apex
    travel = np.array([point.travel_mm for point in curve])
    snr = np.array([point.range.snr for point in curve])
    colour = INTERVAL_COLOURS[interval]
    axes.plot(travel, snr, ls=style, lw=2.2 if apex == "best" else 1.1, color=colour)
    if apex == "best" and (snr > 0).any():
        words = f"{INTERVAL_NAMES[interval]}: bounded from {travel[snr > 0][0]:.1f} mm on"
        axes.text(
            0.03, 0.88 + 0.07 * place, words,
            transform=axes.transAxes, fontsize=9, color=colour,
        )  # fmt: skip


def draw_range(axes: Any, curve: list[Curve]) -> None:
    """One band of the lower panels; an unbounded range reaches the top."""
    travel = np.array([point.travel_mm for point in curve])
    low = np.array([point.range.gap_min for point in curve]) * 1e3
    high = np.nan_to_num(np.array([point.range.gap_max for point in curve]) * 1e3, nan=np.nan, posinf=1e3)
    colour = INTERVAL_COLOURS[curve[0].interval]
    axes.fill_between(travel, low, high, color="white", lw=0)
    axes.fill_between(travel, low, high, color=colour, alpha=0.2, lw=0)
    axes.plot(travel, low, color=colour, lw=1.6)
    axes.plot(travel, high, color=colour, lw=1.6)


def figure_table_4(table: list[Row]) -> Any:
    """Every range of Table 4 beside ours."""
    drawn, grid = figure(1, 1, 9, 5)
    axes = grid[0, 0]
    kinds = {
        "published": GAP_COLOUR,
        "ours, as in the paper": INTERVAL_COLOURS["paper"],
        "ours, worst case": INTERVAL_COLOURS["worst_case"],
    }
    for place, row_ in enumerate(reversed(table)):
        ours = [(found.gap_min * 1e3, found.gap_max * 1e3) for found in (row_.paper, row_.worst_case)]
        ranges = [(row_.published.minimum, row_.published.maximum), *ours]
        for offset, bounds, colour in zip((0.25, 0.0, -0.25), ranges, kinds.values(), strict=True):
            draw_bar(axes, place + offset, *bounds, colour)
    axes.axvline(4, color=MUTED, lw=1, ls=(0, (3, 3)))
    axes.set(xlim=(0, 13.5), xlabel="range of the gap [mm]; the true gap is 4 mm")
    axes.set_yticks(range(len(table)), [row_.scenario.name for row_ in reversed(table)])
    axes.grid(axis="y", visible=False)
    handles = [Line2D([], [], color=colour, lw=5, label=name) for name, colour in kinds.items()]
    drawn.legend(handles=handles, loc="outside lower center", ncols=3)
    return drawn


def draw_bar(axes: Any, y: float, low: float, high: float, colour: str, end: float = 12.0) -> None:
    """A range as a bar with its bounds, cut at `end` [mm]."""
    shown = min(high, end)
    axes.plot([low, shown], [y, y], color=colour, lw=5, solid_capstyle="butt")
    beyond = "→ " if high > end else ""
    words = f"{beyond}{high:.2f}" if math.isfinite(high) else "→ unbounded"
    for x, text, shift, side in ((low, f"{low:.2f}", -4, "right"), (shown, words, 4, "left")):
        axes.annotate(
            text,
            (x, y),
            xytext=(shift, 0),
            textcoords="offset points",
            ha=side,
            va="center_baseline",
            fontsize=8,
        )


def figure_runs(table: list[Row]) -> Any:
    """Errors of the simulated runs with the published mean and three standard deviations."""
    drawn, grid = figure(3, 2, 11, 5.6)
    for axes, row_ in zip(grid.flat, table, strict=True):
        axes.hist(
            row_.runs.errors_mm.clip(-3, 5),
            bins=np.linspace(-3, 5, 81),
            color=INTERVAL_COLOURS["paper"],
            lw=0,
        )
        mean, std = row_.published.mean, row_.published.std
        axes.axvspan(mean - 3 * std, mean + 3 * std, color=ACCENT, lw=0, alpha=0.9)
        axes.set_title(row_.scenario.name)
        axes.text(
            0.98, 0.93,
            f"ours {row_.runs.errors_mm.mean():+.3f} ± {row_.runs.errors_mm.std(ddof=1):.3f}\n"
            f"published {mean:+.4f} ± {std:.4f}",
            transform=axes.transAxes, ha="right", va="top", fontsize=8.5,
            bbox={"facecolor": "white", "lw": 0, "pad": 2},
        )  # fmt: skip
        axes.set(yticks=[], xlim=(-3, 5))
        axes.grid(visible=False)
    for axes in grid[-1]:
        axes.set_xlabel("measured less true gap [mm]")
    return drawn


def figure_sensitivity(fit: Fit) -> Any:
    """RMS difference to rows 1-5 as one parameter of the place moves and the others stay."""
    curves = sensitivity(fit)
    drawn, grid = figure(4, 1, 11, 3.2, sharey=True)
    for axes, (name, (values, rms)) in zip(grid.flat, curves.items(), strict=True):
        axes.plot(values, rms, color=INTERVAL_COLOURS["paper"], lw=1.8)
        axes.plot(getattr(fit.place, name), fit.rms_mm, "o", color=GAP_COLOUR, ms=5)
        unit = "deg" if name.endswith("deg") else "mm"
        axes.set(xlabel=f"{name.rsplit('_', 1)[0]} [{unit}]", ylim=(0, 0.3))
    grid[0, 0].set_ylabel("RMS to rows 1-5 [mm]")
    return drawn
