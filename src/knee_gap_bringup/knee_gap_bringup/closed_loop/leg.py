"""A simulated leg: its joint follows the commanded rate of opening, late and through a play."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LegMechanics:
    """Greatest rate [m/s], time constant of its rate [s], and play between drive and joint [m]."""

    greatest_rate: float = 0.003
    lag: float = 0.08
    backlash: float = 0.3e-3


class SimulatedLeg:
    """The drive runs at the commanded rate after a lag; the joint follows once the play is taken up.

    `opening` [m] is that of the joint; `drive` is the position of the drive on the same scale. The joint is
    moved by the drive alone, and is never forced shut by less than the play.
    """

    def __init__(self, opening: float, mechanics: LegMechanics | None = None) -> None:
        self.mechanics = mechanics or LegMechanics()
        self.opening = opening
        # The drive has the whole play before it.
        self.drive = opening - 0.5 * self.mechanics.backlash
        self.rate = 0.0

    def advance(self, commanded_rate: float, seconds: float) -> None:
        """Let time pass under a command [m/s]."""
        most = self.mechanics.greatest_rate
        wanted = min(max(commanded_rate, -most), most)
        share = float(-np.expm1(-seconds / self.mechanics.lag))
        self.rate += share * (wanted - self.rate)
        self.drive += self.rate * seconds
        half = 0.5 * self.mechanics.backlash
        self.opening = min(max(self.opening, self.drive - half), self.drive + half)
