"""The ROS-free core of an example leg controller: it opens the joint until the instrument fits.

A gap is measured while the joint is at rest. So the leg opens by a step, stops, comes to rest, and the gap is
measured again by a track that began at rest. The first interval of a track is its widest: the leg waits until
it narrows no further before it opens again, and so opens less beyond what is needed. Every estimate is
checked by the same rules, at rest and during a step; a rejected estimate stops the leg at once. Contradictory
estimates hold the leg until a person resets it. `Estimate.from_message` reads messages of rclpy and of bags.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Any, NamedTuple, Self

from knee_gap_bringup.interval_watch import IntervalWatch
from knee_gap_core.values.stamps import NANOSECONDS, stamp_ns

# GapEstimate's constants, since the core does not import messages; a test compares them.
STATUS_VALID = 1
INTERVALS = {0: "worst_case", 1: "paper"}

# Largest time by which a stamp may be in the future [s]: error between two synchronised clocks.
MOST_AHEAD = 0.05
# Longest time between two calls of `LegControl.on_time`, so that a step ends in time [s].
TICK = 0.02
# Tracks remembered by the time of their first image; the oldest are forgotten.
MOST_TRACKS = 4096
# A request for a new track may be lost, or its service may be missing: time between requests [s] while the
# old track continues, and number of requests after which that is a fault.
REQUEST_PERIOD = 0.5
MOST_REQUESTS = 10

MAY_HAVE_MOVED = "the joint may have moved since this track began"


class Action(StrEnum):
    """Action of the leg."""

    HOLD = "hold"
    OPEN = "open"
    PASS = "instrument may pass"


class Command(NamedTuple):
    """Rate at which the joint should open [m/s], and the reason; `measure_again`: the track is to end now."""

    action: Action
    opening_rate: float
    reason: str
    measure_again: bool = False


class Estimate(NamedTuple):
    """The fields of a GapEstimate that the controller uses.

    Lengths [m]; `stamp_ns` of the image [ns]; `age` [s] is its distance from the node's clock. `sequence` is
    the publisher's sequence number, None if the middleware has none.
    """

    is_valid: bool
    track_id: int
    age: float
    gap: float
    gap_min: float
    gap_max: float
    interval: str = "worst_case"
    stamp_ns: int = 0
    sequence: int | None = None

    @classmethod
    def from_message(cls, message: Any, now_ns: int, sequence: int | None = None) -> Self:
        """Return the fields of a GapEstimate, of rclpy or of a bag; `now_ns` is by the node's clock."""
        stamp = stamp_ns(message.header)
        return cls(
            is_valid=message.status == STATUS_VALID,
            track_id=message.track_id,
            age=(now_ns - stamp) / NANOSECONDS,
            gap=message.gap,
            gap_min=message.gap_min,
            gap_max=message.gap_max,
            interval=INTERVALS.get(message.interval, f"number {message.interval}"),
            stamp_ns=stamp,
            sequence=sequence,
        )


@dataclass(frozen=True)
class LegParameters:
    """Settings of the example controller; SI units."""

    instrument_diameter: float = field(
        default=0.004,
        metadata={"description": "diameter of the instrument that must pass [m]", "range": (0.0005, 0.02)},
    )
    largest_gap: float = field(
        default=0.012,
        metadata={"description": "largest gap that the joint's limits allow [m]", "range": (0.001, 0.03)},
    )
    opening_rate: float = field(
        default=0.001,
        metadata={"description": "rate at which the joint is opened [m/s]", "range": (0.0, 0.01)},
    )
    opening_step: float = field(
        default=0.5,
        metadata={"description": "duration of one opening step [s]", "range": (0.05, 5.0)},
    )
    settling: float = field(
        default=0.5,
        metadata={"description": "time for the leg to come to rest after a step [s]", "range": (0.05, 10.0)},
    )
    deadline: float = field(
        default=0.2,
        metadata={"description": "time without an estimate before the leg is held [s]", "range": (0.1, 5.0)},
    )

    max_age: float = field(
        default=0.5,
        metadata={
            "description": "age of an estimate, by its stamp, above which the leg is held [s]; at least "
            "max_delay of uncertainty_node; with a played bag, set --clock and use_sim_time",
            "range": (0.05, 10.0),
        },
    )
    narrowing_time: float = field(
        default=0.5,
        metadata={
            "description": "time without a narrower interval after which the joint is opened [s]; while the "
            "interval of a track narrows, the leg waits. 0: it does not wait",
            "range": (0.0, 5.0),
        },
    )
    longest_wait: float = field(
        default=2.0,
        metadata={"description": "longest time of such a wait in a track [s]", "range": (0.0, 60.0)},
    )
    interval: str = field(
        default="worst_case",
        metadata={
            "description": "error model required of estimates; paper does not always contain the truth",
            "choices": tuple(INTERVALS.values()),
        },
    )

    def __post_init__(self) -> None:
        """Raise ValueError if the leg may not open as far as the instrument needs."""
        if not self.largest_gap > self.instrument_diameter:
            raise ValueError(
                f"largest_gap ({self.largest_gap} m) must exceed instrument_diameter "
                f"({self.instrument_diameter} m)"
            )
        if self.interval not in INTERVALS.values():
            raise ValueError(f"interval is '{self.interval}'; it is one of: {', '.join(INTERVALS.values())}")


def hold(reason: str) -> Command:
    """Return the command to hold the leg."""
    return Command(Action.HOLD, 0.0, reason)


def fault_of(estimate: Estimate) -> str:
    """Why an estimate with the status VALID contradicts itself; empty if it does not."""
    if not estimate.is_valid:
        return ""
    if estimate.track_id == 0:
        return "a valid estimate of no track"
    if not all(isfinite(length) for length in (estimate.gap, estimate.gap_min, estimate.gap_max)):
        return "a valid estimate without finite numbers"
    if not 0.0 <= estimate.gap_min <= estimate.gap <= estimate.gap_max:
        return "a valid estimate outside its own bounds, or with negative ones"
    return ""


def refusal_of(estimate: Estimate, parameters: LegParameters) -> str:
    """Why an estimate must not be acted on, by itself; empty if it may be."""
    if fault := fault_of(estimate):
        return fault
    if not estimate.is_valid:
        return "the gap is not known"
    if not estimate.gap_min > 0.0:
        return "the gap may be closed"
    if not -MOST_AHEAD <= estimate.age <= parameters.max_age:
        return "the estimate is too old or in the future"
    if estimate.interval != parameters.interval:
        return f"the interval is {estimate.interval}, not {parameters.interval}"
    return ""


def decide(estimate: Estimate, parameters: LegParameters) -> Command:
    """Command for one estimate of a joint at rest: its lower bound decides whether the instrument fits."""
    if refusal := refusal_of(estimate, parameters):
        return hold(refusal)
    if estimate.gap_min >= parameters.instrument_diameter:
        return Command(Action.PASS, 0.0, "the whole interval exceeds the instrument")
    if not _time_to_limit(estimate, parameters) > 0.0:
        return hold("the joint may be at its limit")
    return Command(Action.OPEN, parameters.opening_rate, "the gap may be smaller than the instrument")


class LegControl:
    """Opens by a step, waits until the leg is at rest, and then acts only on a track that began after that.

    `on_estimate` takes each estimate, `on_time` the time at least every `TICK`, `on_publishers` the
    publishers of the gap; `now` is a monotonic time [s]. A contradiction is kept in `fault`, and the leg is
    held, until `reset`.

    At its start the leg is taken as moved until then, as after a step: another controller may have moved it.
    A track whose begin was not received is never acted on: the first one, and the first after silence.
    """

    def __init__(self, parameters: LegParameters, now: float) -> None:
        self.parameters = parameters
        self.fault = ""
        # End of the opening step, its track, and end of coming to rest; None if the leg is at rest.
        self._opens_until: float | None = None
        self._step_track = 0
        self._rests_from: float | None = now + parameters.settling
        # Time since which the leg is at rest, and time of the first image of each track.
        self._at_rest_since = float("inf")
        self._first_image: dict[int, float] = {}
        # Requests for a new track since the last new one, and the time of the latest.
        self._requests, self._requested = 0, -float("inf")
        # The estimate with the latest stamp, and the latest stamp of an estimate with a track.
        self._latest: Estimate | None = None
        self._image_ns: int | None = None
        self._sequence = -1
        self._heard: float | None = None
        self._publisher: str | None = None
        self._publishers: frozenset[str] = frozenset()
        self._watch = IntervalWatch(parameters.narrowing_time, parameters.longest_wait)

    def on_estimate(self, estimate: Estimate, now: float) -> Command:
        """Command for an estimate received at `now`."""
        self._note_track(estimate, now)
        self._heard = now
        contradiction = fault_of(estimate) or self._contradiction(estimate)
        # The stamp of an estimate without a track can be slightly later than that of the next image.
        overtaken = self._latest is not None and estimate.stamp_ns < self._latest.stamp_ns
        if not overtaken:
            self._latest = estimate
            self._image_ns = estimate.stamp_ns if estimate.track_id else self._image_ns
        self._sequence = self._sequence if estimate.sequence is None else estimate.sequence
        if contradiction:
            return self.on_fault(contradiction, now)
        if (waiting := self._while_held(now)) is not None:
            return waiting
        command = decide(estimate, self.parameters)
        if overtaken:
            command = hold("a later estimate was received before this one")
        if self._opens_until is not None:
            return self._inside_step(command, estimate, now)
        if not self._first_image.get(estimate.track_id, float("nan")) >= self._at_rest_since:
            # Also if the time of the first image is unknown.
            return self._request_again(command, estimate, now)
        self._requests = 0
        if command.action is Action.OPEN:
            if self._watch.narrows(estimate.track_id, estimate.gap_max - estimate.gap_min, now):
                return hold("the interval still narrows")
            opening = min(self.parameters.opening_step, _time_to_limit(estimate, self.parameters))
            self._opens_until, self._step_track = now + opening, estimate.track_id
        return command

    def on_time(self, now: float) -> Command | None:
        """Command due to the passing of time, None if there is none: end of a step, or no estimate."""
        if self._opens_until is not None and now >= self._opens_until:
            return self._stop(now, "the step is over")
        if self._is_silent(now):
            return self.on_silence(now)
        return self._while_held(now)

    def on_silence(self, now: float) -> Command:
        """Hold the leg: the estimate is late, or its node has died."""
        if self._opens_until is not None:
            self._stop(now, "")
        return self._while_held(now) or hold("no estimate within the deadline")

    def on_publishers(self, publishers: frozenset[str], now: float) -> Command | None:
        """Command for the present publishers of the gap: exactly one, and the same until a reset."""
        self._publishers = publishers
        if len(publishers) > 1:
            return self.on_fault(f"{len(publishers)} nodes publish the gap", now)
        for publisher in publishers:
            if self._publisher not in (None, publisher):
                return self.on_fault("another node publishes the gap now", now)
            self._publisher = publisher
        return None

    def on_fault(self, fault: str, now: float) -> Command:
        """Hold the leg until `reset`; of several faults the first is kept."""
        if self._opens_until is not None:
            self._stop(now, "")
        self.fault = self.fault or fault
        return self._while_held(now) or hold(self.fault)

    def reset(self, now: float) -> str:
        """Clear a fault on a person's request; return why that is not possible yet, empty if it was cleared.

        The leg is assumed to have moved: the gap is measured again before any action.
        """
        if len(self._publishers) > 1:
            return f"{len(self._publishers)} nodes publish the gap; end all but one first"
        self.fault = ""
        self._publisher = next(iter(self._publishers), None)
        self._latest = self._image_ns = None
        self._sequence = -1
        self._requests = 0
        self._stop(now, "")
        return ""

    def _inside_step(self, command: Command, estimate: Estimate, now: float) -> Command:
        assert self._opens_until is not None
        if command.action is not Action.OPEN:
            return self._stop(now, command.reason)
        if estimate.track_id != self._step_track:
            return self._stop(now, "another track")
        if now >= self._opens_until:
            return self._stop(now, "the step is over")
        # As the joint opens, the remaining time to its limit decreases.
        self._opens_until = min(self._opens_until, now + _time_to_limit(estimate, self.parameters))
        return command._replace(reason="a step")

    def _while_held(self, now: float) -> Command | None:
        """Command during a fault or while the leg comes to rest, None otherwise."""
        if self.fault:
            return hold(f"{self.fault}: held until a person resets it")
        if self._rests_from is None:
            return None
        if now < self._rests_from:
            return hold("the leg is coming to rest")
        self._at_rest_since, self._rests_from = self._rests_from, None
        self._requests, self._requested = 1, now
        return hold("the joint may have moved: measuring the gap again")._replace(measure_again=True)

    def _request_again(self, command: Command, estimate: Estimate, now: float) -> Command:
        """Hold the leg for an estimate of an old track; request a new one again if the old one continues."""
        command = hold(MAY_HAVE_MOVED) if estimate.is_valid else command
        if estimate.track_id == 0 or now - self._requested < REQUEST_PERIOD:
            return command
        if self._requests >= MOST_REQUESTS:
            return self.on_fault(f"no new track after {self._requests} requests to measure again", now)
        self._requests, self._requested = self._requests + 1, now
        return command._replace(measure_again=True)

    def _note_track(self, estimate: Estimate, now: float) -> None:
        """Store the time of the first image of a track; NaN if it may have begun unnoticed."""
        if estimate.track_id and estimate.track_id not in self._first_image:
            if len(self._first_image) >= MOST_TRACKS:
                del self._first_image[next(iter(self._first_image))]
            # A stamp in the future does not make a track newer.
            first = float("nan") if self._is_silent(now) else now - max(estimate.age, 0.0)
            self._first_image[estimate.track_id] = first

    def _is_silent(self, now: float) -> bool:
        """Whether no estimate was received within the deadline."""
        return self._heard is None or now - self._heard > self.parameters.deadline

    def _contradiction(self, estimate: Estimate) -> str:
        """How an estimate contradicts those before it; empty if it does not."""
        latest = self._latest
        if estimate.sequence is not None and estimate.sequence <= (
            -1 if self._sequence is None else self._sequence
        ):
            return "messages of more than one publisher"
        if latest is None:
            return ""
        if estimate.stamp_ns == latest.stamp_ns:
            # Two estimates without a track have no numbers that could differ.
            differ = latest.track_id or estimate.track_id or latest.is_valid or estimate.is_valid
            return "two messages of one stamp differ" if differ and not _agree(estimate, latest) else ""
        back = (latest.stamp_ns - estimate.stamp_ns) / NANOSECONDS
        behind_image = self._image_ns is not None and estimate.stamp_ns < self._image_ns
        return "the stamps run backwards" if behind_image or back > self.parameters.max_age else ""

    def _stop(self, now: float, reason: str) -> Command:
        self._opens_until, self._rests_from = None, now + self.parameters.settling
        return hold(reason)


def _time_to_limit(estimate: Estimate, parameters: LegParameters) -> float:
    """How long the joint may open until it may be at its limit [s]; infinite for a leg that does not move."""
    room = parameters.largest_gap - estimate.gap_max
    if room <= 0.0 or parameters.opening_rate > 0.0:
        return room / max(parameters.opening_rate, 1e-12)
    return float("inf")


def _agree(one: Estimate, other: Estimate) -> bool:
    """Whether two messages with the same stamp agree; NaN equals NaN."""
    pairs = zip(
        (one.is_valid, one.track_id, one.interval, one.gap, one.gap_min, one.gap_max),
        (other.is_valid, other.track_id, other.interval, other.gap, other.gap_min, other.gap_max),
        strict=True,
    )
    return all(a == b or (a != a and b != b) for a, b in pairs)
