"""The paper's own arithmetic, done again: what it prints, and what its tables and equations give."""

from itertools import product
from typing import NamedTuple

import numpy as np

from knee_gap_uncertainty.numerics.vectors import row, vector
from knee_gap_uncertainty.studies.paper.geometry import Fit, exact_views
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, TABLE_4, TABLE_4_AVERAGE
from knee_gap_uncertainty.two_view.angle_sets import SIGNS, perturbed_angles
from knee_gap_uncertainty.two_view.length_sensitivity import length_bound_linear, length_change
from knee_gap_uncertainty.two_view.translation_volume import DIRECTIONS
from knee_gap_uncertainty.two_view.triangulation import triangle_angles


class Check(NamedTuple):
    """A statement of the paper, what it prints, and what follows from its own numbers."""

    statement: str
    printed: str
    follows: str


def checks(fit: Fit) -> list[Check]:
    """All statements that can be checked by numbers."""
    return [*image_checks(), *table_checks(), *bound_checks(fit)]


def image_checks() -> list[Check]:
    """Degrees per pixel, and the averages of Table 2."""
    table_2 = (
        ("medial", 5.215, 3.388, 4.302),
        ("patello-femoral", 1.961, 2.774, 2.367),
        ("lateral", 4.048, 7.125, 5.586),
    )
    averages = ", ".join(f"{name} {(one + other) / 2:.4f}" for name, one, other, _ in table_2)
    return [
        Check("DPP_x, 90 deg over 1280 px [deg/px]", "0.075", f"{90 / 1280:.4f}"),
        Check("DPP_y, 90 deg over 720 px [deg/px]", "0.125", f"{90 / 720:.4f}"),
        Check("image error of the medial compartment [deg]", "2.36 (item 2)", f"Table 2: {averages}"),
        Check(
            "largest image error [deg] (sets 2 and 3: 'maximum measured')",
            "5.586",
            "Table 2: 7.125, lateral, G1",
        ),
    ]


def table_checks() -> list[Check]:
    """Statements of the text about Table 4, compared with Table 4."""
    first = [TABLE_4[number] for number in range(1, 5)]
    low, high = (float(np.mean([getattr(cell, name) for cell in first])) for name in ("minimum", "maximum"))
    widths = {SCENARIOS[i].angle_deg: cell.maximum - cell.minimum for i, cell in enumerate(first)}
    printed_widths = ", ".join(f"{width:.3f} mm at {angle:g} deg" for angle, width in widths.items())
    best = min(widths, key=lambda angle: widths[angle])
    spread = {name: np.ptp([getattr(cell, name) for cell in first]) for name in ("minimum", "maximum")}
    everything = list(TABLE_4.values())
    means, stds = (float(np.mean([getattr(cell, name) for cell in everything])) for name in ("mean", "std"))
    return [
        Check("average minimum and maximum of set 1 [mm]", "3.426, 4.577", f"{low:.3f}, {high:.3f}"),
        Check("gap underestimated by [%]", "13.91", f"{(4 - low) / 4 * 100:.2f}"),
        Check("gap overestimated by [%]", "14.03", f"{(high - 4) / 4 * 100:.2f}"),
        Check("average range of set 1 [mm]", "1.1172", f"{high - low:.4f}"),
        Check("the same as a share of the gap [%]", "27", f"{(high - low) / 4 * 100:.1f}"),
        Check("best angle of travel [deg]", "45", f"{best:g} ({printed_widths})"),
        Check("'higher angles are slightly worse than the lower angles'", "worse", printed_widths),
        Check(
            "largest effect of the angle [mm]", "0.169",
            f"minima {spread['minimum']:.3f}, maxima {spread['maximum']:.3f}",
        ),
        Check(
            "mean and std of the measurements [mm]", "-0.0028, 0.0096",
            f"set 1 {TABLE_4_AVERAGE.mean}, {TABLE_4_AVERAGE.std}; all six rows {means:.4f}, {stds:.4f}",
        ),
    ]  # fmt: skip


def bound_checks(fit: Fit) -> list[Check]:
    """How often the exact change of length exceeds the linear one that (9)-(11) offer as its bound."""
    exceeded, compared, worst = 0, 0, 0.0
    for scenario in SCENARIOS:
        views = exact_views(fit.place, scenario)
        shifts = scenario.translation_error * DIRECTIONS
        for n, start, end, signs in product(range(2), shifts, shifts, SIGNS["all"]):
            own, other = row(views.bearings_0, n), row(views.bearings_1, n)
            alpha, beta = triangle_angles(vector(views.travel), own, other)
            displaced = views.travel + end - start
            angles = perturbed_angles(
                triangle_angles(vector(displaced), own, other), signs, scenario.angular_error
            )
            changes = {
                "travel_change": float(np.linalg.norm(displaced)) - views.baseline,
                "own_change": angles[0] - alpha,
                "other_change": angles[1] - beta,
            }
            excess = length_change(views.baseline, alpha, beta, **changes) - length_bound_linear(
                views.baseline, alpha, beta, **changes
            )
            compared += 1
            exceeded += excess > 0
            worst = max(worst, excess)
    return [
        Check(
            "(11) bounds Delta L of (8), signs of psi as in (17), (18)", "always ('<=')",
            f"exceeded in {exceeded} of {compared} cases, by up to {worst * 1e3:.2f} mm",
        )
    ]  # fmt: skip
