"""The paper's simulation parameters (Table 3) and results (Table 4), as printed, in its units."""

import math
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class Scenario:
    """One simulated measurement: a row of Table 4 with its set of Table 3."""

    number: int
    parameter_set: int
    angle_deg: float
    translation_error_mm: float
    gap_mm: float
    travel_mm: float
    image_error_deg: float
    rotation_error_deg: float

    @property
    def angular_error(self) -> float:
        """Bound psi = theta + omega of the error of a bearing [rad]."""
        return math.radians(self.image_error_deg + self.rotation_error_deg)

    @property
    def translation_error(self) -> float:
        """Bound Delta T of the error of a lens position [m]."""
        return self.translation_error_mm / 1e3

    @property
    def name(self) -> str:
        """Words for a legend."""
        return f"{self.angle_deg:g}°, set {self.parameter_set}, {self.travel_mm:g} mm"


class Published(NamedTuple):
    """A row of Table 4 [mm]."""

    minimum: float
    maximum: float
    mean: float
    std: float


def set_1(number: int, angle_deg: float, travel_mm: float = 2.0) -> Scenario:
    """Average errors."""
    return Scenario(number, 1, angle_deg, 0.0367, 4.0, travel_mm, 2.36, 0.004)


def largest_errors(number: int, parameter_set: int, travel_mm: float) -> Scenario:
    """The largest measured errors, of sets 2 and 3, always at 45 degrees."""
    return Scenario(number, parameter_set, 45.0, 0.0698, 4.0, travel_mm, 5.586, 0.177)


SCENARIOS = (
    set_1(1, 0.0),
    set_1(2, 30.0),
    set_1(3, 45.0),
    set_1(4, 90.0),
    largest_errors(5, 2, 2.0),
    largest_errors(6, 3, 8.0),
)

TABLE_4 = {
    1: Published(3.351, 4.724, -0.0052, 0.0147),
    2: Published(3.492, 4.525, -0.0032, 0.0086),
    3: Published(3.346, 4.562, -0.0067, 0.0052),
    4: Published(3.515, 4.497, 0.0221, 0.0054),
    5: Published(2.875, 5.256, -0.019, 0.0016),
    6: Published(3.525, 4.495, 0.0063, 0.0013),
}
TABLE_4_AVERAGE = Published(3.426, 4.577, 0.0018, 0.0085)

TABLE_3_COLUMNS = ("set", "angles", "DT_mm", "gap_mm", "t_mm", "theta_deg", "omega_deg")
TABLE_3 = (
    (1, "0°, 30°, 45°, 90°", 0.0367, 4, "2", 2.36, 0.004),
    (2, "45°", 0.0698, 4, "2", 5.586, 0.177),
    (3, "45°", 0.0698, 4, "8", 5.586, 0.177),
    (4, "90°", 0.0367, 4, "0.1:0.1:8", 2.36, 0.004),
)
