"""Errors of this package."""

from knee_gap_core.values.errors import KneeGapError


class PerceptionError(KneeGapError):
    """An input or a setting that breaks a rule; the message names the rule, the value and the choices."""
