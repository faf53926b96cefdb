"""Errors of the simulation."""

from knee_gap_core.values.errors import KneeGapError


class SimulationError(KneeGapError):
    """Settings that cannot be simulated; the message names the rule that is broken."""
