"""The rules that the metadata of a parameter's field states, for all who build one, with ROS and without.

A field's metadata holds `description`; for numbers, `range` (lowest, highest, both allowed; each number of a
tuple) and `nan`: True where NaN stands for "not given"; for strings, `choices`.
"""

from dataclasses import fields
from math import isnan
from typing import Any


def broken_rule(parameters: Any) -> str:
    """The first rule that a field of a dataclass breaks, with its value, in words; empty where none is."""
    for field in fields(parameters):
        value = getattr(parameters, field.name)
        choices = field.metadata.get("choices")
        if choices and value not in choices:
            return f"{field.name} must be one of {', '.join(choices)}, not '{value}'"
        if bounds := field.metadata.get("range"):
            nan_allowed = bool(field.metadata.get("nan", False))
            for number in value if isinstance(value, tuple) else (value,):
                if rule := _broken_range(field.name, number, bounds, nan_allowed=nan_allowed):
                    return rule
    return ""


def _broken_range(name: str, number: Any, bounds: tuple[float, float], *, nan_allowed: bool) -> str:
    lowest, highest = bounds
    if isinstance(number, bool) or not isinstance(number, int | float):
        return f"{name} must be a number, not {number!r}"
    if (isnan(number) and nan_allowed) or lowest <= number <= highest:
        return ""
    return f"{name} must lie in [{lowest:g}, {highest:g}], not {number:g}"
