"""Errors of this package."""


class PerceptionError(ValueError):
    """An input or a setting that breaks a rule; the message names the rule, the value and the choices."""
