"""Errors of the simulation."""


class SimulationError(ValueError):
    """Settings that cannot be simulated; the message names the rule that is broken."""
