"""Validation of parameters: frozen dataclasses with default, meaning and range in their metadata."""

from typing import Any

from knee_gap_core.node.parameter_rules import broken_rule
from knee_gap_perception.errors import PerceptionError


def check_parameters(parameters: Any) -> None:
    """Raise PerceptionError for the first field of a dataclass that breaks the rule in its metadata."""
    if rule := broken_rule(parameters):
        raise PerceptionError(rule)
