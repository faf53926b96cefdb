"""The closed loop in one process: knee, estimator and example controller, without DDS and without a clock."""

import time as clock
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from knee_gap_bringup.closed_loop.faults import EXCESS, OVERTAKEN, Fault, FaultSchedule
from knee_gap_bringup.closed_loop.leg import LegMechanics, SimulatedLeg
from knee_gap_bringup.closed_loop.views import OpeningKnee
from knee_gap_bringup.leg_control import TICK, Action, Command, Estimate, LegControl, LegParameters, hold
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_simulation.knee_views import ViewErrors
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimation.messages import fill_gap_estimate
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

# The simulated clock at the start [s]; how long before a tick an image is exposed [s], so that its stamp is
# that of no other event; and after how many ticks more its edges arrive.
_BEGIN, _EXPOSED_BEFORE, _LATENCY = 100.0, 0.007, 1
# A person resets the controller this long after it reported a fault [s].
_RESET_AFTER = 2.0
_LEAST_OPENING, _MOST_OPENING = 0.0022, 0.0034


@dataclass(frozen=True)
class LoopSettings:
    """A closed loop. Lengths [m], times [s]; `image_period` is rounded to whole ticks."""

    seed: int
    fault: Fault = Fault.NONE
    leg: LegParameters = field(default_factory=LegParameters)
    mechanics: LegMechanics = field(default_factory=LegMechanics)
    level: int = 1
    duration: float = 60.0
    image_period: float = 0.04


class Heard(NamedTuple):
    """An estimate as the controller received it: time [s], validity, and its numbers [m]."""

    time: float
    is_valid: bool
    gap: float
    gap_min: float
    gap_max: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a loop. Lengths [m], times [s] since its start.

    `passed_at` is when the controller let the instrument pass, NaN if it did not; `true_gap` the true
    instrument gap then, or at the end. `trace` (n, 3): time, opening, commanded rate.
    """

    settings: LoopSettings
    passed_at: float
    true_gap: float
    end: float
    resets: int
    last_reason: str
    trace: np.typing.NDArray[np.float64]
    heard: tuple[Heard, ...]
    spans: np.typing.NDArray[np.float64]
    cpu_seconds: float

    @property
    def passed(self) -> bool:
        """Whether the instrument was let pass."""
        return bool(np.isfinite(self.passed_at))

    @property
    def beyond_need(self) -> float:
        """How much wider the joint was opened than the instrument needs [m]; NaN if that is not known."""
        return self.true_gap - self.settings.leg.instrument_diameter

    @property
    def wrongly_passed(self) -> bool:
        """Whether an instrument was let pass that does not fit; also if the truth is not known."""
        return self.passed and not self.beyond_need >= 0.0

    @property
    def beyond_limit(self) -> bool:
        """Whether the joint was opened beyond its limit."""
        return bool(self.true_gap > self.settings.leg.largest_gap)


class ClosedLoop:
    """A knee, a leg, the estimator and the controller, advanced tick by tick."""

    def __init__(self, settings: LoopSettings) -> None:
        """Raise SimulationError if the scope does not fit into the joint."""
        self.settings = settings
        rng = np.random.default_rng([settings.seed, 0x4C4F])
        opening = float(rng.uniform(_LEAST_OPENING, _MOST_OPENING))
        excess = EXCESS if settings.fault is Fault.NOISE else 1.0
        self.knee = OpeningKnee(settings.level, settings.seed, opening, ViewErrors(excess=excess))
        self.leg = SimulatedLeg(opening, settings.mechanics)
        self.control = LegControl(settings.leg, _BEGIN)
        self.faults = FaultSchedule(settings.fault, settings.seed, settings.duration)
        self.command = hold("no estimate received yet")
        self.passed_on: int | None = None
        self.resets = 0
        self.heard: list[Heard] = []
        self._rng = rng
        self._estimator: GapEstimator | None = None
        self._message = blank("knee_gap_msgs/msg/GapEstimate")
        self._images: deque[tuple[int, GapEdges, LensPose]] = deque()
        self._last: tuple[GapEdges, LensPose] | None = None
        self._held_back: list[GapEstimate] = []
        self._overtaken: GapEstimate | None = None
        self._fault_since = float("nan")

    def advance(self, tick: int) -> None:
        """Let one tick pass: an image, what the estimator makes of it, the controller, the leg."""
        time = tick * TICK
        every = max(1, round(self.settings.image_period / TICK))
        if tick and tick % every == 0:
            self._take_image(tick, time - _EXPOSED_BEFORE)
        for estimate in self._arriving(self._estimates(tick, time), time):
            self._hear(estimate, time)
        self._obey(self.control.on_time(_BEGIN + time), time)
        self._reset(time)
        self.leg.advance(self.command.opening_rate, TICK)

    def _take_image(self, tick: int, time: float) -> None:
        stamp_ns = _nanoseconds(time)
        edges, pose = self.knee.observe(stamp_ns, time, self.leg.opening)
        if self._last is not None:
            earlier_edges, earlier_pose = self._last
            if self.faults.is_present(Fault.FROZEN_VIDEO, time):
                edges = replace(earlier_edges, stamp_ns=stamp_ns)
            if self.faults.is_present(Fault.FROZEN_TRACKER, time):
                pose = replace(earlier_pose, stamp_ns=stamp_ns)
        self._last = (edges, pose)
        self._images.append((tick + _LATENCY, edges, pose))

    def _estimates(self, tick: int, time: float) -> list[GapEstimate]:
        """What the estimator publishes at a tick."""
        now_ns = _nanoseconds(time)
        published: list[GapEstimate] = []
        if self.faults.is_present(Fault.SILENT, time):
            self._estimator = None
            self._images.clear()
            return []
        if self._estimator is None:
            # As a node that was started: it reports that it has received nothing yet.
            self._estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE))
            published += self._estimator.begin(now_ns)
        while self._images and self._images[0][0] <= tick:
            _, edges, pose = self._images.popleft()
            if not self.faults.is_present(Fault.LOST, time):
                published += self._estimator.add_pose(pose, now_ns)
            published += self._estimator.add_edges(edges, now_ns)
        published += self._estimator.advance(now_ns, 0)
        return [self._estimator.leaving(one, now_ns) for one in published]

    def _arriving(self, published: list[GapEstimate], time: float) -> list[GapEstimate]:
        """What of the published estimates reaches the controller now, and in which order."""
        if self.faults.is_present(Fault.STALE, time):
            self._held_back += published
            return []
        arriving = [*self._held_back, *published]
        self._held_back = []
        if self.faults.fault is Fault.REORDERED and arriving:
            if self._overtaken is not None:
                arriving.append(self._overtaken)
                self._overtaken = None
            elif self._rng.random() < OVERTAKEN:
                self._overtaken = arriving.pop()
        return arriving

    def _hear(self, estimate: GapEstimate, time: float) -> None:
        message: Any = fill_gap_estimate(self._message, estimate)
        heard = Estimate.from_message(message, _nanoseconds(time))
        self.heard.append(Heard(time, heard.is_valid, heard.gap, heard.gap_min, heard.gap_max))
        self._obey(self.control.on_estimate(heard, _BEGIN + time), time)
        if self.command.action is Action.PASS and self.passed_on is None:
            self.passed_on = estimate.stamp_ns

    def _obey(self, command: Command | None, time: float) -> None:
        if command is None:
            return
        if command.measure_again:
            self.knee.measure_again()
        self.command = command
        if not self.control.fault:
            self._fault_since = float("nan")
        elif np.isnan(self._fault_since):
            self._fault_since = time

    def _reset(self, time: float) -> None:
        """A person's reset of a fault."""
        if time - self._fault_since >= _RESET_AFTER and not self.control.reset(_BEGIN + time):
            self.resets += 1
            self._fault_since = float("nan")


def run_loop(settings: LoopSettings) -> Outcome:
    """Run a loop until the instrument may pass, or its time is over. Raises SimulationError."""
    begin = clock.process_time()
    loop = ClosedLoop(settings)
    trace: list[tuple[float, float, float]] = []
    for tick in range(round(settings.duration / TICK)):
        loop.advance(tick)
        trace.append((tick * TICK, loop.leg.opening, loop.command.opening_rate))
        if loop.passed_on is not None:
            break
    end = trace[-1][0]
    return Outcome(
        settings=settings,
        passed_at=end if loop.passed_on is not None else float("nan"),
        true_gap=loop.knee.true_gap(loop.passed_on),
        end=end,
        resets=loop.resets,
        last_reason=loop.command.reason,
        trace=np.array(trace),
        heard=tuple(loop.heard),
        spans=loop.faults.spans,
        cpu_seconds=clock.process_time() - begin,
    )


def _nanoseconds(time: float) -> int:
    return round((_BEGIN + time) * NANOSECONDS)
