"""The place of the gap that gives Table 4: a seeded search, and how little the table determines it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from knee_gap_core.values.errors import MeasurementError
from knee_gap_uncertainty.studies.paper.geometry import Fit, GapPlace, exact_views
from knee_gap_uncertainty.studies.paper.scenarios import SCENARIOS, TABLE_4
from knee_gap_uncertainty.two_view.error_cloud import Apex
from knee_gap_uncertainty.two_view.gap_range import gap_range

# Middle of the gap [mm], tilt and turn [deg].
LOWEST = np.array([-15.0, -25.0, -20.0, -90.0, -90.0])
HIGHEST = np.array([15.0, 25.0, 20.0, 90.0, 90.0])
TRIES = 5000
REFINED = 40
SEED = 1
# A place that cannot be measured, or is unbounded, differs by this much [mm].
WORST_DIFFERENCE_MM = 10.0


@dataclass(frozen=True)
class Reading:
    """What a search goes by: the clouds' apex, whether the gap may be turned, how many rows count."""

    name: str
    apex: Apex
    turned: bool = False
    rows: int = 5


READINGS = (
    Reading("b_n, as stated", "first"),
    Reading("a_n", "second"),
    Reading("b_n, gap turned in the x-y plane", "first", turned=True),
    Reading("b_n, fitted to all six rows", "first", rows=6),
)

# Found by `study --fit`; every other command uses the first.
FITTED = {
    "b_n, as stated": Fit(GapPlace(-2.62656, 1.72239, -4.99650, 82.7681), "first", 0.04278),
    "a_n": Fit(GapPlace(-0.70004, 4.19533, -0.16165, 84.7912), "second", 0.04331),
    "b_n, gap turned in the x-y plane": Fit(
        GapPlace(-1.77436, -3.78764, -0.85194, 22.6700, 19.1735), "first", 0.03215
    ),
    "b_n, fitted to all six rows": Fit(GapPlace(-3.29583, -3.72649, -3.74361, -61.5190), "first", 0.06353),
}


def differences_mm(place: GapPlace, apex: Apex, rows: int = 5) -> npt.NDArray[np.float64]:
    """Our minimum and maximum by the paper's interval less Table 4's, (rows, 2) [mm]."""
    found = np.full((rows, 2), WORST_DIFFERENCE_MM)
    for i, scenario in enumerate(SCENARIOS[:rows]):
        views = exact_views(place, scenario)
        try:
            ours = gap_range(
                views.lens_0, views.lens_1, views.bearings_0, views.bearings_1,
                angular_error=scenario.angular_error, translation_error=scenario.translation_error,
                interval="paper", apex=apex,
            )  # fmt: skip
        except MeasurementError:
            continue
        published = TABLE_4[scenario.number]
        found[i] = ours.gap_min * 1e3 - published.minimum, ours.gap_max * 1e3 - published.maximum
    return np.clip(found, -WORST_DIFFERENCE_MM, WORST_DIFFERENCE_MM)


def rms_mm(place: GapPlace, apex: Apex, rows: int = 5) -> float:
    """Root mean square of the differences over the rows [mm]."""
    return float(np.sqrt((differences_mm(place, apex, rows) ** 2).mean()))


def search(reading: Reading, seed: int = SEED) -> Iterator[Fit]:
    """Fits, each no worse than the last: random places, the best of them refined by the simplex method.

    Yields TRIES + REFINED times, so that progress can be shown; the last is the answer.
    """
    free = 5 if reading.turned else 4

    def fitted(parameters: npt.NDArray[np.float64]) -> Fit:
        place = place_of(parameters)
        return Fit(place, reading.apex, rms_mm(place, reading.apex, reading.rows))

    def cost(parameters: npt.NDArray[np.float64]) -> float:
        return fitted(parameters).rms_mm

    tries = np.random.default_rng(seed).uniform(LOWEST[:free], HIGHEST[:free], size=(TRIES, free))
    costs = np.empty(TRIES)
    best = fitted(tries[0])
    for i, parameters in enumerate(tries):
        found = fitted(parameters)
        costs[i] = found.rms_mm
        best = min(best, found, key=lambda fit: fit.rms_mm)
        yield best
    for i in np.argsort(costs)[:REFINED]:
        options = {"xatol": 1e-3, "fatol": 1e-6, "maxiter": 900}
        found = fitted(minimize(cost, tries[i], method="Nelder-Mead", options=options).x)
        best = min(best, found, key=lambda fit: fit.rms_mm)
        yield best


def place_of(parameters: npt.NDArray[np.float64]) -> GapPlace:
    """Place of the numbers in order; a tilt and its opposite are the same gap, its ends exchanged."""
    x, y, z, tilt, *turn = parameters.tolist()
    return GapPlace(x, y, z, (tilt + 90) % 180 - 90, *turn)


def sensitivity(fit: Fit) -> dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """For each parameter of the place: its values around the fit [mm or deg], and the RMS difference [mm]."""
    spans = {"x_mm": 2.0, "y_mm": 2.0, "z_mm": 2.0, "tilt_deg": 30.0}
    curves = {}
    for name, span in spans.items():
        values = getattr(fit.place, name) + np.linspace(-span, span, 41)
        curves[name] = values, np.array([rms_mm(replace(fit.place, **{name: v}), fit.apex) for v in values])
    return curves
