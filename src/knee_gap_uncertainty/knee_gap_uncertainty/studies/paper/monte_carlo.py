"""Simulated runs of a scenario, errors random within their bounds: the mean and std of Table 4 again."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.errors import MeasurementError
from knee_gap_uncertainty.studies.paper.geometry import Fit, exact_views
from knee_gap_uncertainty.studies.paper.scenarios import Scenario
from knee_gap_uncertainty.two_view.gap_range import GapRange, gap_range
from knee_gap_uncertainty.two_view.two_views import TwoViews


@dataclass(frozen=True)
class Runs:
    """What became of the simulated runs of one scenario.

    `errors_mm`: measured less true gap of the runs that were not refused; `unbounded`: how many of them
    without a maximum by the worst case. `held_paper`, `held_worst_case`: share of them whose range holds the
    true gap.
    """

    errors_mm: npt.NDArray[np.float64]
    refused: int
    unbounded: int
    held_paper: float
    held_worst_case: float


def simulate(fit: Fit, scenario: Scenario, runs: int, rng: np.random.Generator) -> Runs:
    """Measure the scenario's gap `runs` times, each with new errors of both lenses and all four bearings."""
    exact = exact_views(fit.place, scenario)
    errors, held = [], []
    unbounded = 0
    for _ in range(runs):
        views = shaken(exact, scenario, rng)
        try:
            paper, worst = (measured(views, scenario, fit, name) for name in ("paper", "worst_case"))
        except MeasurementError:
            continue
        gap = scenario.gap_mm / 1e3
        errors.append((paper.gap - gap) * 1e3)
        unbounded += math.isinf(worst.gap_max)
        held.append([found.gap_min <= gap <= found.gap_max for found in (paper, worst)])
    shares = np.mean(held, axis=0) if held else np.full(2, math.nan)
    return Runs(np.array(errors), runs - len(errors), unbounded, float(shares[0]), float(shares[1]))


def measured(views: TwoViews, scenario: Scenario, fit: Fit, interval: str) -> GapRange:
    """Gap and range from the views, with the scenario's error bounds."""
    return gap_range(
        views.lens_0, views.lens_1, views.bearings_0, views.bearings_1,
        angular_error=scenario.angular_error, translation_error=scenario.translation_error,
        interval="paper" if interval == "paper" else "worst_case", apex=fit.apex,
    )  # fmt: skip


def shaken(views: TwoViews, scenario: Scenario, rng: np.random.Generator) -> TwoViews:
    """The views, each lens displaced by up to Delta T and each bearing turned by up to psi, evenly."""
    lenses = [
        lens + rng.uniform(0, scenario.translation_error) * direction(rng)
        for lens in (views.lens_0, views.lens_1)
    ]
    bearings = [
        np.stack([turned(b, rng.uniform(0, scenario.angular_error), rng) for b in pair])
        for pair in (views.bearings_0, views.bearings_1)
    ]
    return TwoViews(*lenses, *bearings)


def direction(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """A random unit vector (3,)."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def turned(
    bearing: npt.NDArray[np.float64], angle: float, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """The unit vector turned by an angle [rad] towards a random side."""
    side = np.cross(bearing, direction(rng))
    return math.cos(angle) * bearing + math.sin(angle) * side / float(np.linalg.norm(side))
