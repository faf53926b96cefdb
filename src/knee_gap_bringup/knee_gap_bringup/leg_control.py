"""An example of what a leg controller does with the gap: open until the instrument fits, never on a guess.

The gap is that of a joint that holds still: so the leg is opened by a step, stopped, and measured anew.
"""

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
    """Rate at which the joint should open [m/s] and why; `measure_anew`: the track shall end now."""

    action: Action
    opening_rate: float
    reason: str
    measure_anew: bool = False


class Estimate(NamedTuple):
    """What the controller looks at in a GapEstimate; lengths [m], `age` [s] by its stamp.

    `is_blind`: points or lens are not seen, or nothing can be told of them.
    """

    is_valid: bool
    track_id: int
    age: float
    gap_min: float
    gap_max: float
    is_blind: bool = False


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
    opening_step: float = field(
        default=0.5,
        metadata={"description": "time for which the joint is opened at once [s]", "range": (0.05, 5.0)},
    )
    settling: float = field(
        default=0.5,
        metadata={"description": "time after which the leg is at rest again [s]", "range": (0.05, 10.0)},
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


def decide(estimate: Estimate, parameters: LegParameters) -> Command:
    """Command from one estimate of a joint at rest: its lower bound says whether the instrument fits."""
    if not estimate.is_valid or not isfinite(estimate.gap_min) or not isfinite(estimate.gap_max):
        return Command(Action.HOLD, 0.0, "the gap is not known")
    if not abs(estimate.age) <= parameters.max_age:
        return Command(Action.HOLD, 0.0, "the estimate is not of now")
    if estimate.gap_min >= parameters.instrument_diameter:
        return Command(Action.PASS, 0.0, "the whole interval exceeds the instrument")
    if estimate.gap_max >= parameters.largest_gap:
        return Command(Action.HOLD, 0.0, "the joint may be at its limit")
    return Command(Action.OPEN, parameters.opening_rate, "the gap may be smaller than the instrument")


class LegControl:
    """Opens by a step, waits until the leg is at rest, and believes nothing but a track begun after that."""

    def __init__(self, parameters: LegParameters) -> None:
        self.parameters = parameters
        # Until when the leg opens, and until when it comes to rest; None where it is at rest.
        self._opens_until: float | None = None
        self._rests_from: float | None = None
        self._latest_track = 0
        self._spent_track: int | None = None

    def on_estimate(self, estimate: Estimate, now: float) -> Command:
        """Command at a time `now` [s] that never runs backwards."""
        self._latest_track = estimate.track_id or self._latest_track
        if self._opens_until is not None:
            if now < self._opens_until and not estimate.is_blind:
                return Command(Action.OPEN, self.parameters.opening_rate, "a step")
            self._stop(now)
        if self._rests_from is not None:
            if now < self._rests_from:
                return Command(Action.HOLD, 0.0, "the leg comes to rest")
            self._rests_from, self._spent_track = None, self._latest_track
            return Command(Action.HOLD, 0.0, "the joint has moved: it is measured anew", measure_anew=True)
        if estimate.track_id == self._spent_track:
            return Command(Action.HOLD, 0.0, "the joint has moved since this track began")
        command = decide(estimate, self.parameters)
        if command.action is Action.OPEN:
            self._opens_until = now + self.parameters.opening_step
        return command

    def on_silence(self, now: float) -> Command:
        """Hold the leg: whoever measures the gap is late or dead."""
        if self._opens_until is not None:
            self._stop(now)
        return Command(Action.HOLD, 0.0, "no estimate within the deadline")

    def _stop(self, now: float) -> None:
        self._opens_until, self._rests_from = None, now + self.parameters.settling
