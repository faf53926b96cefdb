"""A seeded schedule of faults in a closed loop."""

from enum import StrEnum

import numpy as np
import numpy.typing as npt


class Fault(StrEnum):
    """A fault between the knee and the controller."""

    NONE = "none"
    LOST = "lost"  # the tracker does not see the scope: no lens pose
    FROZEN_VIDEO = "frozen-video"  # the images show an earlier view, with new stamps
    FROZEN_TRACKER = "frozen-tracker"  # the poses repeat an earlier one, with new stamps
    STALE = "stale"  # the estimates are held back, and then arrive all at once
    REORDERED = "reordered"  # an estimate arrives after the next one
    SILENT = "silent"  # no estimate at all, and then a node that was started again
    NOISE = "noise"  # all errors are twice as large as stated


# Of a fault that comes and goes: mean time between two of them, and their least and greatest duration [s].
_BETWEEN, _SHORTEST, _LONGEST = 3.0, 0.1, 1.5
# Fraction of the estimates that the next one overtakes.
OVERTAKEN = 0.005
# How much larger the errors are than stated.
EXCESS = 2.0


# Faults that come and go; the others last for the whole run, or are of single messages.
_PASSING = (Fault.LOST, Fault.FROZEN_VIDEO, Fault.FROZEN_TRACKER, Fault.STALE, Fault.SILENT)


class FaultSchedule:
    """The times at which a fault is present, `spans` (n, 2) [s]; the same seed gives the same times."""

    def __init__(self, fault: Fault, seed: int, duration: float) -> None:
        self.fault = fault
        rng = np.random.default_rng([seed, 0x4641])
        spans: list[tuple[float, float]] = []
        time = float(rng.exponential(_BETWEEN))
        while time < duration and fault in _PASSING:
            end = time + float(rng.uniform(_SHORTEST, _LONGEST))
            spans.append((time, end))
            time = end + float(rng.exponential(_BETWEEN))
        self.spans: npt.NDArray[np.float64] = np.array(spans, dtype=np.float64).reshape(-1, 2)

    def is_present(self, fault: Fault, time: float) -> bool:
        """Whether a fault that comes and goes is present at a time [s]."""
        if fault is not self.fault:
            return False
        return bool(((self.spans[:, 0] <= time) & (time < self.spans[:, 1])).any())
