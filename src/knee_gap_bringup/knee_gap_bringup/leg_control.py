"""An example of what a leg controller does with the gap: open until the instrument fits, never on a guess."""

from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import NamedTuple


class Action(StrEnum):
    """What the leg should do, in words."""

    HOLD = "hold"
    OPEN = "open"
    PASS = "instrument may pass"


class Command(NamedTuple):
    """Rate at which the joint should open [m/s] and why."""

    action: Action
    opening_rate: float
    reason: str


@dataclass(frozen=True)
class LegParameters:
    """Settings of the example controller; SI units."""

    instrument_diameter: float = field(
        default=0.004,
        metadata={"description": "diameter of the instrument that must pass [m]", "range": (0.0005, 0.02)},
    )
    largest_gap: float = field(
        default=0.012,
        metadata={"description": "gap that the joint's limits allow [m]", "range": (0.001, 0.03)},
    )
    opening_rate: float = field(
        default=0.001,
        metadata={"description": "rate at which the joint is opened [m/s]", "range": (0.0, 0.01)},
    )
    deadline: float = field(
        default=0.2,
        metadata={"description": "silence of the gap after which the leg is held [s]", "range": (0.1, 5.0)},
    )

    max_age: float = field(
        default=0.5,
        metadata={
            "description": "age of an estimate, by its stamp, above which the leg is held; a bag that is "
            "played needs --clock and use_sim_time [s]",
            "range": (0.05, 10.0),
        },
    )

    def __post_init__(self) -> None:
        """Refuse a leg that may not open as far as the instrument needs."""
        if not self.largest_gap > self.instrument_diameter:
            raise ValueError(
                f"largest_gap ({self.largest_gap} m) must exceed instrument_diameter "
                f"({self.instrument_diameter} m)"
            )


def decide(valid: bool, age: float, gap_min: float, gap_max: float, parameters: LegParameters) -> Command:
    """Command from one estimate [m] of some age [s]: its lower bound says whether the instrument fits."""
    if not valid or not isfinite(gap_min) or not isfinite(gap_max):
        return Command(Action.HOLD, 0.0, "the gap is not known")
    if not abs(age) <= parameters.max_age:
        return Command(Action.HOLD, 0.0, "the estimate is not of now")
    if gap_min >= parameters.instrument_diameter:
        return Command(Action.PASS, 0.0, "the whole interval exceeds the instrument")
    if gap_max >= parameters.largest_gap:
        return Command(Action.HOLD, 0.0, "the joint may be at its limit")
    return Command(Action.OPEN, parameters.opening_rate, "the gap may be smaller than the instrument")
