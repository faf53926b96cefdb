"""Errors of a node's start."""

from knee_gap_core.values.errors import KneeGapError


class ConfigurationError(KneeGapError):
    """A node cannot start with what it was given; the message names the rule, the value and the choices."""
