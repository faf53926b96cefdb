"""Figures 9a, 10 and 11: the clouds about both points with the vectors to them."""

import math
from typing import Any

import matplotlib.patheffects as effects
import numpy as np
import numpy.typing as npt
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from scipy.spatial import ConvexHull

from knee_gap_uncertainty.studies.paper.figures.drawing import (
    GAP_COLOUR,
    LENS_COLOUR,
    MUTED,
    POINT_COLOURS,
    POINT_TINTS,
    farthest_pair,
    figure,
    measurement_plane,
    nearest_pair,
)
from knee_gap_uncertainty.studies.paper.geometry import Fit, exact_views
from knee_gap_uncertainty.studies.paper.monte_carlo import measured
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, Scenario
from knee_gap_uncertainty.two_view.error_cloud import error_clouds
from knee_gap_uncertainty.two_view.two_views import TwoViews

HALO = [effects.withStroke(linewidth=3, foreground="white")]

Limits = tuple[tuple[float, float], tuple[float, float]]


def clouds_of(fit: Fit, scenario: Scenario, interval: str) -> tuple[npt.NDArray[np.float64], ...]:
    """Both clouds (N, 3) [m] of a scenario."""
    return error_clouds(
        exact_views(fit.place, scenario),
        angular_error=scenario.angular_error,
        translation_error=scenario.translation_error,
        signs="none" if interval == "paper" else "all",
        apex=fit.apex,
    )


def draw_clouds(axes: Any, fit: Fit, scenario: Scenario, limits: Limits, title: str) -> None:
    """Both clouds in the plane of the apex and the gap: as in the paper (full) and the worst case (pale)."""
    views = exact_views(fit.place, scenario)
    points = fit.place.points(scenario.gap_mm)
    lens, other_lens = lenses_of(fit, views)
    plane = measurement_plane(lens, points)
    paper, worst = clouds_of(fit, scenario, "paper"), clouds_of(fit, scenario, "worst_case")
    for n, side in enumerate((-1, 1)):
        end = plane.project(points[n])
        for start, style in ((lens, "-"), (other_lens, (0, (4, 3)))):
            ray = np.stack([plane.project(start), end])
            axes.plot(*ray.T, ls=style, lw=0.9, color=POINT_COLOURS[n], alpha=0.6)
        shadow = plane.project(worst[n])
        axes.fill(*shadow[ConvexHull(shadow).vertices].T, color=POINT_TINTS[n], alpha=0.4, lw=0, zorder=1)
        axes.scatter(*shadow.T, s=2, lw=0, color=POINT_TINTS[n], rasterized=True, zorder=1.5)
        axes.scatter(*plane.project(paper[n]).T, s=3, lw=0, color=POINT_COLOURS[n], rasterized=True, zorder=2)
        axes.plot(*end, "o", ms=4, color="white", mec=GAP_COLOUR, mew=1.2, zorder=5)
        axes.annotate(
            f"$G_{n}$", end, xytext=(24 * side, 10), textcoords="offset points",
            ha="center", va="center", zorder=6, path_effects=HALO,
        )  # fmt: skip
    draw_travel(axes, plane.project(lens), plane.project(other_lens), fit)
    for pair, style in ((nearest_pair(*paper), "-"), (farthest_pair(*paper), "--")):
        axes.plot(*plane.project(np.stack(pair)).T, color=GAP_COLOUR, lw=1.4, ls=style, zorder=4)
    ours = measured(views, scenario, fit, "paper")
    wide = measured(views, scenario, fit, "worst_case")
    axes.set_title(title, pad=34)
    axes.text(
        0.0, 1.015,
        f"paper {ours.gap_min * 1e3:.2f} to {ours.gap_max * 1e3:.2f} mm\n"
        f"worst case {wide.gap_min * 1e3:.2f} to {upper(wide.gap_max)}",
        transform=axes.transAxes, fontsize=9, color=MUTED, va="bottom",
    )  # fmt: skip
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")


def lenses_of(fit: Fit, views: TwoViews) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The clouds' own lens and the other one (3,) [m]."""
    return (views.lens_0, views.lens_1) if fit.apex == "first" else (views.lens_1, views.lens_0)


def upper(gap_max: float) -> str:
    """An upper bound in words."""
    return f"{gap_max * 1e3:.2f} mm" if math.isfinite(gap_max) else "unbounded"


def draw_travel(axes: Any, lens: Any, other_lens: Any, fit: Fit) -> None:
    """The two lens positions, with an arrow in the direction of travel."""
    names = ("$A_0$", "$A_1$") if fit.apex == "first" else ("$A_1$", "$A_0$")
    start, end = (lens, other_lens) if fit.apex == "first" else (other_lens, lens)
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": LENS_COLOUR, "lw": 1.6})
    away = np.sign(lens - other_lens + 1e-12)
    for place, name, side in ((lens, names[0], away), (other_lens, names[1], -away)):
        axes.plot(*place, "o", ms=5, color=LENS_COLOUR, zorder=5)
        axes.annotate(
            name,
            place,
            xytext=(9 * side[0], 7 * side[1]),
            textcoords="offset points",
            ha="center",
            va="center",
        )


def common_limits(fit: Fit, scenarios: list[Scenario], deepest_mm: float) -> Limits:
    """Limits [mm] that hold the lenses and all clouds of every scenario, down to a depth."""
    seen = []
    for scenario in scenarios:
        views = exact_views(fit.place, scenario)
        lens, other_lens = lenses_of(fit, views)
        plane = measurement_plane(lens, fit.place.points(scenario.gap_mm))
        seen.append(plane.project(np.stack([lens, other_lens])))
        seen += [plane.project(cloud) for cloud in clouds_of(fit, scenario, "worst_case")]
    places = np.concatenate(seen)
    places = places[places[:, 1] < deepest_mm]
    low, high = places.min(axis=0) - 0.5, places.max(axis=0) + 0.5
    half = max(-low[0], high[0])
    return (-float(half), float(half)), (float(low[1]) - 0.3, float(high[1]))


def label(drawn: Any, grid: Any) -> None:
    """Axis names once a row and column, and one legend for all."""
    for axes in grid[-1]:
        axes.set_xlabel("across the view [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("depth from the lens [mm]")
    dots = [
        tuple(Line2D([], [], ls="", marker="o", ms=5, color=colour) for colour in colours)
        for colours in (POINT_COLOURS, POINT_TINTS)
    ]
    lines = [
        Line2D([], [], color=GAP_COLOUR, lw=1.5),
        Line2D([], [], color=GAP_COLOUR, lw=1.5, ls="--"),
        Line2D([], [], color=LENS_COLOUR, lw=1.5, marker=">", ms=5),
    ]
    names = ["clouds, paper", "clouds, worst case", "smallest gap, paper", "largest gap, paper", "travel"]
    drawn.legend(
        [*dots, *lines], names, loc="outside lower center", ncols=5 if grid.size > 1 else 3,
        handler_map={tuple: HandlerTuple(ndivide=None)},
    )  # fmt: skip


def figure_9a(fit: Fit) -> Any:
    """Clouds at 0 degrees."""
    drawn, grid = figure(1, 1, 6.4, 7.6)
    draw_clouds(
        grid[0, 0], fit, SCENARIOS[0], common_limits(fit, [SCENARIOS[0]], 14.0), "0°, 2 mm of travel, set 1"
    )
    label(drawn, grid)
    return drawn


def figure_10(fit: Fit) -> Any:
    """Clouds at 30, 45 and 90 degrees, and at 45 degrees with the largest errors."""
    chosen = list(SCENARIOS[1:5])
    drawn, grid = figure(4, 1, 12, 6)
    limits = common_limits(fit, chosen, 10.0)
    for axes, letter, scenario in zip(grid.flat, "abcd", chosen, strict=True):
        draw_clouds(axes, fit, scenario, limits, f"({letter})  {scenario.name}")
    label(drawn, grid)
    return drawn


def figure_11(fit: Fit) -> Any:
    """Clouds after 2 and after 8 mm of travel, largest errors."""
    chosen = [SCENARIOS[4], SCENARIOS[5]]
    drawn, grid = figure(2, 1, 11, 8.2)
    limits = common_limits(fit, chosen, 14.0)
    for axes, letter, scenario in zip(grid.flat, "ab", chosen, strict=True):
        draw_clouds(axes, fit, scenario, limits, f"({letter})  {scenario.travel_mm:g} mm of travel, 45°")
    label(drawn, grid)
    return drawn
