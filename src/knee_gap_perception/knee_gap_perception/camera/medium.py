"""Media in front of the scope's window: their refractive indices and the errors of these.

A scope is calibrated in one medium and used in another. At a flat window perpendicular to the view
sin(angle in use) n_use = sin(angle at the calibration) n_calibration (Snell), whatever glass lies between.
"""

from dataclasses import dataclass
from math import hypot
from typing import Any

from knee_gap_perception.errors import PerceptionError

INDICES = {"air": 1.0, "saline": 1.336, "water": 1.333}
# The index of saline is 1.330-1.340, depending on temperature, salinity and the colour of the light. The
# standard deviation of a uniform distribution is half that range divided by the square root of 3. The error
# of a gas is negligible.
LIQUID_ERROR = 0.003
HIGHEST_GAS = 1.01
LOWEST, HIGHEST = 1.0, 1.6
CHOICES = f"{', '.join(INDICES)} or a refractive index in [{LOWEST:g}, {HIGHEST:g}]"


@dataclass(frozen=True)
class Medium:
    """A transparent medium and its refractive index; media of one index are the same."""

    index: float

    @property
    def index_error(self) -> float:
        """Standard error of the index [-]."""
        return 0.0 if self.index <= HIGHEST_GAS else LIQUID_ERROR

    @property
    def value(self) -> str | float:
        """Its name, or the index of a medium without a name, as accepted by `medium_of`."""
        return next((name for name, index in INDICES.items() if index == self.index), self.index)

    def ratio_to(self, use: "Medium") -> float:
        """Sine of an angle in `use` to the sine of the same ray's angle in this medium."""
        return self.index / use.index

    def ratio_error_to(self, use: "Medium") -> float:
        """Relative standard error of `ratio_to`: 0 for the same medium, whose index cancels."""
        if self == use:
            return 0.0
        return hypot(self.index_error / self.index, use.index_error / use.index)


AIR, SALINE, WATER = (Medium(index) for index in INDICES.values())


def medium_of(value: Any, name: str = "the medium") -> Medium:
    """The medium given by a parameter or argument `name`: a name or an index, also as text.

    Raises PerceptionError for anything else.
    """
    if isinstance(value, str) and value in INDICES:
        return Medium(INDICES[value])
    try:
        index = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        index = float("nan")
    if not LOWEST <= index <= HIGHEST:
        raise PerceptionError(f"{name} must be {CHOICES}, not '{value}'")
    return Medium(index)
