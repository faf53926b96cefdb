"""Parameters as frozen dataclasses: one place for each default, its meaning and the values it may take.

A field's metadata holds `description`; for numbers, `range` (lowest, highest, both allowed; each number of a
tuple) and `nan`: True where NaN stands for "not given"; for strings, `choices`.
"""

from dataclasses import fields
from math import isnan
from typing import Any

from knee_gap_perception.errors import PerceptionError


def check_parameters(parameters: Any) -> None:
    """Raise PerceptionError for the first field of a dataclass that breaks the rule in its metadata."""
    for field in fields(parameters):
        value = getattr(parameters, field.name)
        choices = field.metadata.get("choices")
        if choices and value not in choices:
            raise PerceptionError(f"{field.name} must be one of {', '.join(choices)}, not '{value}'")
        if bounds := field.metadata.get("range"):
            _check_range(field.name, value, bounds, nan_allowed=field.metadata.get("nan", False))


def _check_range(name: str, value: Any, bounds: tuple[float, float], *, nan_allowed: bool) -> None:
    lowest, highest = bounds
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise PerceptionError(f"{name} must be a number, not {number!r}")
        if isnan(number) and nan_allowed:
            continue
        if not lowest <= number <= highest:
            raise PerceptionError(f"{name} must lie in [{lowest:g}, {highest:g}], not {number:g}")
