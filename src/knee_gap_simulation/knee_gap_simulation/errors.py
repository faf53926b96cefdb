"""Errors of the simulation."""


class SimulationError(ValueError):
    """What was asked for cannot be simulated; the message says which rule it breaks."""
