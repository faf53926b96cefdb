"""Outlier rejection for tracked poses: drop-outs, jumps, frozen drivers and impossible numbers."""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf, isfinite, nan
from statistics import median

import numpy as np

from knee_gap_core.values.poses import FARTHEST, BodyPose, is_place
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.scope_pose.label_swaps import SwappedBodies

# A body that jumped away, or was not seen, is taken back within what the fastest motion reaches in this time
# [s], however long it was gone: otherwise any second jump, or any that nobody saw, would count as its return.
RETURN_TIME = 0.05

# Stamps jitter by less than this share of a period: a single lost frame is a gap of two, not of more.
JITTER_PERIODS = 0.25


class RefusalReason(StrEnum):
    """Why a pose is not published, in one word for diagnostics."""

    NO_STAMP = "no_stamp"
    STAMP_BACKWARDS = "stamp_backwards"
    DUPLICATE = "duplicate"
    NOT_TRACKED = "not_tracked"
    NOT_FINITE = "not_finite"
    NOT_UNIT = "not_unit"
    TOO_FAR = "too_far"
    MEAN_ERROR = "mean_error"
    FROZEN = "frozen"
    SWAPPED = "swapped"
    JUMP = "jump"
    GAP = "gap"
    NO_REFERENCE = "no_reference"
    NO_TURN = "no_turn"


@dataclass(frozen=True)
class Refusal:
    """A pose that is not published as valid; `detail` is the reason, with the value and the limit."""

    stamp_ns: int
    reason: RefusalReason
    detail: str


@dataclass(frozen=True)
class ValidityParameters:
    """Limits beyond which a tracked pose is not a measurement of a scope in a hand.

    Raises PerceptionError for a limit outside its range.
    """

    tracker_rate: float = field(
        default=nan,
        metadata={
            "description": "Frames a second of the tracker [Hz]; NaN learns it from the stamps",
            "range": (1.0, 2000.0),
            "nan": True,
        },
    )
    max_gap_periods: float = field(
        default=2.0,
        metadata={
            "description": "Longest time between two poses, in periods of the tracker [-]; the pose that "
            "ends a longer gap is not published",
            "range": (1.0, 1000.0),
        },
    )
    max_speed: float = field(
        default=1.0,
        metadata={
            "description": "Fastest motion of the body without a jump [m/s]",
            "range": (0.001, 100.0),
        },
    )
    max_angular_speed: float = field(
        default=15.0,
        metadata={
            "description": "Fastest rotation of the body without a jump [rad/s]",
            "range": (0.01, 1000.0),
        },
    )
    jump_hold: float = field(
        default=10.0,
        metadata={
            "description": "Time after a jump or a swap of labels in which poses are refused unless the body "
            "comes back to where it was [s]; infinite waits for the return",
            "range": (0.0, inf),
        },
    )
    max_mean_error: float = field(
        default=0.001,
        metadata={
            "description": "Largest mean residual of the body's markers [m]",
            "range": (0.0, inf),
        },
    )
    quaternion_tolerance: float = field(
        default=0.001,
        metadata={
            "description": "Largest difference of a quaternion's length from 1 [-]",
            "range": (0.0, 0.1),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)


class PoseValidity:
    """Judges the poses of one body in the order in which they come.

    A pose is refused when the tracker does not see the body, when it is malformed, and when it cannot be the
    next pose of a body that moved there: see `RefusalReason`. `counts` holds the refusals by reason since the
    start.
    """

    def __init__(self, parameters: ValidityParameters | None = None) -> None:
        self.parameters = parameters or ValidityParameters()
        self.counts: Counter[RefusalReason] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget all poses, not the counts."""
        self._stamp_ns: int | None = None
        self._intervals: deque[float] = deque(maxlen=51)
        # Their median; None if it is to be found again.
        self._usual: float | None = None
        self._last: BodyPose | None = None
        self._before_jump: BodyPose | None = None
        self._jump_stamp_ns = 0
        self._swapped = SwappedBodies()
        self._swap_stamp_ns: int | None = None

    @property
    def period(self) -> float:
        """Period of the tracker [s]; NaN until known."""
        if isfinite(self.parameters.tracker_rate):
            return 1.0 / self.parameters.tracker_rate
        if self._usual is None:
            self._usual = median(self._intervals) if len(self._intervals) >= 5 else nan
        return self._usual

    def check(self, body: BodyPose, others: Iterable[BodyPose] = ()) -> Refusal | None:
        """Return why `body` is not to be believed, or None; `others` are the bodies of the same frame."""
        found = self._stamp_fault(body)
        if found is None:
            # In every frame, also while the body itself is not seen: the others move meanwhile.
            swapped_with = self._swapped_with(body, tuple(others))
            found = self._form_fault(body) or self._motion_fault(body, swapped_with)
        if found is None:
            return None
        return self.refuse(body, *found)

    def refuse(self, body: BodyPose, reason: RefusalReason, detail: str) -> Refusal:
        """Count a refusal for whatever reason, and return it."""
        self.counts[reason] += 1
        return Refusal(body.stamp_ns, reason, detail)

    def _stamp_fault(self, body: BodyPose) -> tuple[RefusalReason, str] | None:
        if body.stamp_ns <= 0:
            return RefusalReason.NO_STAMP, "the pose has no stamp: the driver must give its time"
        previous = self._stamp_ns
        if previous is not None and body.stamp_ns < previous:
            back = (previous - body.stamp_ns) / 1e9
            self.reset()
            self._stamp_ns = body.stamp_ns
            return RefusalReason.STAMP_BACKWARDS, f"stamps went back by {back:.3f} s: earlier poses dropped"
        if previous == body.stamp_ns:
            return RefusalReason.DUPLICATE, "the pose has the stamp of the one before it"
        if previous is not None:
            self._intervals.append((body.stamp_ns - previous) / 1e9)
            self._usual = None
            if body.stamp_ns - previous > RETURN_TIME * 1e9:
                # Time in which nothing came confirms neither a jump nor where the labels are.
                self._jump_stamp_ns += body.stamp_ns - previous
                if self._swap_stamp_ns is not None:
                    self._swap_stamp_ns += body.stamp_ns - previous
        self._stamp_ns = body.stamp_ns
        return None

    def _form_fault(self, body: BodyPose) -> tuple[RefusalReason, str] | None:
        limits = self.parameters
        if not body.tracking_valid:
            return RefusalReason.NOT_TRACKED, "the tracker does not see the body"
        if not (np.isfinite(body.position).all() and np.isfinite(body.quaternion_xyzw).all()):
            return RefusalReason.NOT_FINITE, "the pose has numbers that are NaN or infinite"
        if not is_place(body.position):
            return RefusalReason.TOO_FAR, f"the body is farther than {FARTHEST:g} m: are positions in metres?"
        # Clipped before it is squared, which overflows.
        length = float(np.linalg.norm(np.clip(body.quaternion_xyzw, -1e6, 1e6)))
        if abs(length - 1.0) > limits.quaternion_tolerance:
            return (
                RefusalReason.NOT_UNIT,
                f"the quaternion has length {length:.6g}, not 1 within {limits.quaternion_tolerance:g}",
            )
        if body.mean_error > limits.max_mean_error:
            return (
                RefusalReason.MEAN_ERROR,
                f"the markers' mean residual is {body.mean_error * 1e3:.3f} mm, "
                f"above {limits.max_mean_error * 1e3:.3f} mm",
            )
        return None

    def _swapped_with(self, body: BodyPose, others: tuple[BodyPose, ...]) -> str | None:
        other = self._swapped.update((body, *others)).get(body.name)
        if other is None:
            # Not seen is not a return: the time of a swap goes on until the label is back on its body.
            if body.tracking_valid:
                self._swap_stamp_ns = None
            return None
        if self._swap_stamp_ns is None:
            self._swap_stamp_ns = body.stamp_ns
        if body.stamp_ns - self._swap_stamp_ns < self.parameters.jump_hold * 1e9:
            return other
        self._swapped = SwappedBodies()
        self._swapped.update((body, *others))
        self._swap_stamp_ns = None
        # The labels are believed from here on: the body begins where its label is, and its next pose is
        # judged by that. This one has nothing to be judged by: it may be a frozen one.
        self._last, self._before_jump = body, None
        return other

    def _motion_fault(self, body: BodyPose, swapped_with: str | None) -> tuple[RefusalReason, str] | None:
        last = self._last
        if swapped_with is not None:
            # While the labels are in doubt, no time that passes confirms a jump.
            self._jump_stamp_ns = body.stamp_ns
            return (
                RefusalReason.SWAPPED,
                f"labels swapped: the tracker gives the body's label to '{swapped_with}'",
            )
        if last is not None and _identical(last, body):
            return RefusalReason.FROZEN, "the pose repeats the one before it bit by bit: the driver is frozen"
        self._last = body
        if last is None:
            return None
        return self._jump(last, body) or self._gap(last, body)

    def _gap(self, last: BodyPose, body: BodyPose) -> tuple[RefusalReason, str] | None:
        gap = (body.stamp_ns - last.stamp_ns) / 1e9
        longest = (self.parameters.max_gap_periods + JITTER_PERIODS) * self.period
        if not gap > longest:
            return None
        return RefusalReason.GAP, f"no pose for {gap * 1e3:.1f} ms, longer than {longest * 1e3:.1f} ms"

    def _jump(self, last: BodyPose, body: BodyPose) -> tuple[RefusalReason, str] | None:
        origin = self._before_jump
        continues = self._reach(last, body) <= 1.0
        if origin is None and continues:
            return None
        if origin is None:
            self._before_jump, self._jump_stamp_ns = last, body.stamp_ns
            return RefusalReason.JUMP, f"the body {_motion(last, body)}"
        held = (body.stamp_ns - self._jump_stamp_ns) / 1e9
        if continues:
            if held < self.parameters.jump_hold:
                return RefusalReason.JUMP, f"the body jumped {held:.3f} s ago and has not come back"
        elif self._reach(origin, body) > 1.0:
            self._jump_stamp_ns = body.stamp_ns
            return RefusalReason.JUMP, f"the body jumped again: it {_motion(last, body)}"
        self._before_jump = None
        return None

    def _reach(self, start: BodyPose, end: BodyPose) -> float:
        """How far `end` is from `start`, as a share of what the fastest motion reaches; above 1 is a jump."""
        elapsed = min(abs(end.stamp_ns - start.stamp_ns) / 1e9, RETURN_TIME)
        # Stamps that jitter must not turn a short interval into a high speed.
        if isfinite(self.period):
            elapsed = max(elapsed, self.period)
        distance, angle = distance_and_angle(start, end)
        limits = self.parameters
        return max(distance / (limits.max_speed * elapsed), angle / (limits.max_angular_speed * elapsed))


def distance_and_angle(start: BodyPose, end: BodyPose) -> tuple[float, float]:
    """Distance [m] and angle of rotation [rad] between two poses."""
    distance = float(np.linalg.norm(end.position - start.position))
    p, q = start.quaternion_xyzw, end.quaternion_xyzw
    # The half angle by its tangent: the cosine alone has no digits left near zero.
    sine, cosine = (
        min(np.linalg.norm(p - q), np.linalg.norm(p + q)),
        max(np.linalg.norm(p - q), np.linalg.norm(p + q)),
    )
    return distance, 4.0 * float(np.arctan2(sine, cosine))


def _motion(start: BodyPose, end: BodyPose) -> str:
    distance, angle = distance_and_angle(start, end)
    elapsed = (end.stamp_ns - start.stamp_ns) / 1e9
    moved = f"moved {distance * 1e3:.1f} mm and turned {np.degrees(angle):.1f} deg"
    return f"{moved} in {elapsed * 1e3:.1f} ms: a jump"


def _identical(first: BodyPose, second: BodyPose) -> bool:
    return (
        first.position.tobytes() == second.position.tobytes()
        and first.quaternion_xyzw.tobytes() == second.quaternion_xyzw.tobytes()
    )
