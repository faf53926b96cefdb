"""Place of the gap relative to the scope: a parameter, because the paper does not give it.

As printed, the lens ends at the origin after a travel of T from (-T sin rho, -T cos rho, 0), and rho = 0 is
perpendicular to the gap's projection onto the x-y plane: that projection lies along x. Left open are the
gap's middle and its tilt.
"""

import math
from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.studies.paper.scenarios import Scenario
from knee_gap_uncertainty.two_view.error_cloud import Apex
from knee_gap_uncertainty.two_view.two_views import TwoViews, two_views


@dataclass(frozen=True)
class GapPlace:
    """Middle of the gap from the last lens position [mm], tilt out of the x-y plane and turn in it [deg].

    The paper's own words leave no turn; it is there to see what it would mend.
    """

    x_mm: float
    y_mm: float
    z_mm: float
    tilt_deg: float
    turn_deg: float = 0.0

    def points(self, gap_mm: float) -> npt.NDArray[np.float64]:
        """G0 and G1 (2, 3) [m]."""
        tilt, turn = math.radians(self.tilt_deg), math.radians(self.turn_deg)
        along = np.array([math.cos(tilt) * math.cos(turn), math.cos(tilt) * math.sin(turn), math.sin(tilt)])
        middle = np.array([self.x_mm, self.y_mm, self.z_mm])
        return np.asarray(np.stack([middle - gap_mm / 2 * along, middle + gap_mm / 2 * along]) / 1e3)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The five numbers in order."""
        return astuple(self)


@dataclass(frozen=True)
class Fit:
    """A place, the apex of its clouds, and the RMS of its differences to the rows it was fitted to [mm]."""

    place: GapPlace
    apex: Apex
    rms_mm: float


def lens_positions(scenario: Scenario) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """A0 and A1 (3,) [m]."""
    angle = math.radians(scenario.angle_deg)
    start = -scenario.travel_mm / 1e3 * np.array([math.sin(angle), math.cos(angle), 0.0])
    return start, np.zeros(3)


def exact_views(place: GapPlace, scenario: Scenario) -> TwoViews:
    """What a scope without errors would see."""
    lenses = lens_positions(scenario)
    points = place.points(scenario.gap_mm)
    rays = [points - lens for lens in lenses]
    bearings = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    return two_views(*lenses, *bearings)
