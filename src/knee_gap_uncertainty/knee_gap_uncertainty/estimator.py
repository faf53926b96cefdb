"""The estimator: posed observations of the two edges go in, estimates with bounds come out.

The live node, the offline processing of a bag and the simulation run this same object; only what feeds it
differs. It waits for nothing and reads no clock: whoever feeds it says when each message arrived, and
calls `advance` when time passes without one.
"""

from collections import Counter, deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from knee_gap_uncertainty.advice_task import PIECES, AdviceTask
from knee_gap_uncertainty.errors import MeasurementError
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.gap_estimate import EdgeObservation, GapEstimate, GapStatus
from knee_gap_uncertainty.leg_body import LegBody
from knee_gap_uncertainty.motion_advice import AdviceParameters, MotionAdvice, Situation
from knee_gap_uncertainty.pose_buffer import LensPose, PoseBuffer, PoseRefusal
from knee_gap_uncertainty.scope_calibration import CalibrationError, ScopeCalibration, contradiction
from knee_gap_uncertainty.scope_turns import ScopeTurn, ScopeTurns, TurnRefusal
from knee_gap_uncertainty.track import Track

NANOSECONDS = 1_000_000_000

# The most images that may wait for a pose: at 60 Hz over two seconds, far beyond any allowed wait.
MOST_PENDING = 128
LEG_MOVED = "the leg body moved"
UNKNOWN_MOTION = "the clock is uncertain, and no two lens poses near the image tell how fast the lens moved"
NO_NUMBERS = "the views, or the calibration's error, cannot be calculated with"


# A quarter of a second of a tracker: slow replay, whose stamps fall behind the clock, is no delay.
POSES_OF_DELAY = 32
LATE = "the image came too long after the lens poses of its time"

# Advice that nobody has taken yet.
MOST_ADVICE = 16


class Pending(NamedTuple):
    """Edges that wait for the lens pose after them, and when they arrived [ns]."""

    edges: EdgeObservation
    arrival_ns: int


class GapEstimator:
    """Fuses edges and lens poses into one estimate an image, in the order of the images.

    Advice on motion is made while time passes; whoever wants it takes it from `advice`.
    """

    def __init__(
        self, parameters: EstimatorParameters | None = None, advice: AdviceParameters | None = None
    ) -> None:
        self.parameters = parameters or EstimatorParameters()
        self.advice: deque[MotionAdvice] = deque(maxlen=MOST_ADVICE)
        self._advice_task = AdviceTask(advice)
        self.counts: Counter[str] = Counter()
        self.latest: GapEstimate | None = None
        self._poses = PoseBuffer(max_pose_age=self.parameters.max_pose_age)
        self._turns = ScopeTurns(self.parameters.max_pose_age)
        # Whether a turn was ever told: it is followed then, and an image without one is of an unknown scope.
        self._turn_told = False
        self._pending: deque[Pending] = deque()
        self._track: Track | None = None
        self._leg = LegBody(self.parameters.max_pose_age) if self.parameters.leg_motion > 0.0 else None
        # Where the leg body was when the track began.
        self._leg_at_first: LensPose | None = None
        self.calibrations: dict[str, ScopeCalibration] = {}
        self.calibration_flaw = ""
        self._calibration_error: CalibrationError | None = None
        self._frame_id = ""
        # By how much the clock was ahead of the stamps of the latest poses: what an image's delay is held to.
        self._pose_delays_ns: deque[int] = deque(maxlen=POSES_OF_DELAY)
        self._last_edges: Pending | None = None
        self._silence_told_ns = 0
        self._now_ns = 0

    @property
    def advice_parameters(self) -> AdviceParameters:
        """What the advice aims at."""
        return self._advice_task.parameters

    def add_pose(self, pose: LensPose, arrival_ns: int, queued_ns: int = 0) -> list[GapEstimate]:
        """Take a lens pose, which had lain in a queue; return the estimates that it made possible."""
        self._turn_clock(arrival_ns)
        refusal = self._poses.add(pose)
        if refusal is not None:
            self.counts[f"pose refused: {refusal.value}"] += 1
        else:
            if pose.frame_id != self._frame_id:
                self._turns.forget_before(pose.stamp_ns)
            self._frame_id = pose.frame_id
            self._pose_delays_ns.append(arrival_ns - queued_ns - pose.stamp_ns)
        return self._resolve(arrival_ns)

    def add_turn(self, told: ScopeTurn, arrival_ns: int) -> list[GapEstimate]:
        """Take how far the scope is turned in its camera head; return the estimates that it made possible."""
        self._turn_clock(arrival_ns)
        if not self._turn_is_followed():
            # The views before had none.
            self._track = None
        self._turn_told = True
        if refusal := self._turns.add(told):
            self.counts[f"scope_turn refused: {refusal.value}"] += 1
        return self._resolve(arrival_ns)

    def add_leg_pose(self, pose: LensPose) -> None:
        """Take a pose of the leg body; it is without effect where `leg_motion` is 0."""
        if self._leg is None:
            return
        refusal = self._leg.add(pose)
        if refusal is not None:
            self.counts[f"leg body refused: {refusal.value}"] += 1

    def add_calibration(self, told: ScopeCalibration) -> None:
        """Take what a node says of its calibration.

        Where nodes contradict each other, or tell an error that is none, nothing is valid.
        """
        known = self.calibrations.get(told.node)
        self.calibrations[told.node] = told
        flaws = [contradiction(self.calibrations), *(one.flaw() for one in self.calibrations.values())]
        self.calibration_flaw = next((flaw for flaw in flaws if flaw), "")
        errors = [one.error for one in self.calibrations.values() if not one.flaw()]
        self._calibration_error = next((error for error in errors if error is not None), None)
        if known is None or not told.says_the_same_as(known):
            # Views by another calibration are not comparable with those before.
            self._track = None

    def add_edges(self, edges: EdgeObservation, arrival_ns: int) -> list[GapEstimate]:
        """Take the edges of one image; return the estimates that are ready."""
        self._turn_clock(arrival_ns)
        last = self._last_edges
        if last is not None and edges.stamp_ns == last.edges.stamp_ns:
            # The image was answered; its repetition is no new one, nor an end of silence.
            self.counts["images with the stamp of the one before"] += 1
            return self._resolve(arrival_ns)
        if last is not None and edges.stamp_ns < last.edges.stamp_ns:
            self.counts["stamps ran backwards"] += 1
            self._pending.clear()
            self._pose_delays_ns.clear()
            self._track = None
        self._last_edges = Pending(edges, arrival_ns)
        self._silence_told_ns = arrival_ns
        if len(self._pending) == MOST_PENDING:
            self.counts["images dropped while waiting for poses"] += 1
            self._pending.popleft()
        self._pending.append(Pending(edges, arrival_ns))
        return self._resolve(arrival_ns)

    def advance(self, now_ns: int, advice_pieces: int = PIECES) -> list[GapEstimate]:
        """Let time pass; return the estimates that must not wait any longer, and what silence means.

        `advice_pieces`: how much work on advice may be done meanwhile.
        """
        self._turn_clock(now_ns)
        if advice := self._advice_task.turn(self._situation(), advice_pieces):
            self.advice.append(advice)
        estimates = self._resolve(now_ns)
        if self._last_edges is None or self._pending:
            return estimates
        silence_ns = now_ns - self._silence_told_ns
        if silence_ns > self.parameters.max_edges_silence * NANOSECONDS:
            self._silence_told_ns = now_ns
            last = self._last_edges
            # The only stamp that is not an image's: no image came, and the statement needs a time.
            stamp_ns = last.edges.stamp_ns + now_ns - last.arrival_ns
            estimates.append(self._without(stamp_ns, GapStatus.NO_EDGES, 0, "no edges arrive"))
        return estimates

    def _turn_clock(self, now_ns: int) -> None:
        """Take the time; where it runs backwards (a bag that starts again) nothing waits any longer."""
        if now_ns < self._now_ns:
            self.counts["clock ran backwards"] += 1
            self._pending.clear()
            self._pose_delays_ns.clear()
            if self._last_edges is not None:
                self._last_edges = self._last_edges._replace(arrival_ns=now_ns)
                self._silence_told_ns = now_ns
        self._now_ns = now_ns

    def _resolve(self, now_ns: int) -> list[GapEstimate]:
        """Estimates of every pending image, in order, up to the first that may still wait for its pose."""
        estimates = []
        while self._pending:
            estimate = self._try(self._pending[0], now_ns)
            if estimate is None:
                break
            self._pending.popleft()
            estimates.append(estimate)
        return estimates

    def _try(self, pending: Pending, now_ns: int) -> GapEstimate | None:
        """Estimate of one image, or None while its lens pose, or the turn at it, may still come."""
        edges = pending.edges
        if flaw := edges.flaw():
            return self._without(edges.stamp_ns, GapStatus.NO_EDGES, edges.track_id, flaw)
        may_wait = now_ns - pending.arrival_ns <= self.parameters.max_pose_wait * NANOSECONDS
        pose = self._poses.at(edges.stamp_ns)
        if isinstance(pose, LensPose):
            if self._is_late(pending):
                return self._without(edges.stamp_ns, GapStatus.OUT_OF_SYNC, edges.track_id, LATE)
            turn = self._turns.at(edges.stamp_ns) if self._turn_is_followed() else 0.0
            if not isinstance(turn, TurnRefusal):
                return self._measure(edges, replace(pose, scope_turn=turn))
            if turn is TurnRefusal.NOT_YET and may_wait:
                return None
            reason = TurnRefusal.NONE_NEAR.value
            return self._without(edges.stamp_ns, GapStatus.OUT_OF_SYNC, edges.track_id, reason)
        if pose is PoseRefusal.NOT_YET:
            if may_wait:
                return None
            return self._without(
                edges.stamp_ns, GapStatus.TRACKING_LOST, edges.track_id, "no lens pose follows the image"
            )
        return self._without(edges.stamp_ns, GapStatus.OUT_OF_SYNC, edges.track_id, pose.value)

    def _turn_is_followed(self) -> bool:
        """Whether somebody tells, or says that he will, how far the scope is turned in its camera head."""
        return self._turn_told or any(one.turn_followed for one in self.calibrations.values())

    def _is_late(self, pending: Pending) -> bool:
        """Whether an image came so long after the poses of its time that its answer is of the past."""
        if not self._pose_delays_ns:
            return False
        delay_ns = pending.arrival_ns - pending.edges.stamp_ns - min(self._pose_delays_ns)
        return delay_ns > self.parameters.max_delay * NANOSECONDS

    def _measure(self, edges: EdgeObservation, pose: LensPose) -> GapEstimate:
        """Estimate from the edges and their lens pose, within the track that they belong to."""
        if self.calibration_flaw:
            self._track = None
            return self._without(edges.stamp_ns, GapStatus.UNKNOWN, edges.track_id, self.calibration_flaw)
        if self._leg is not None and (flaw := self._leg.flaw(edges.stamp_ns, pose.frame_id)):
            return self._without(edges.stamp_ns, GapStatus.TRACKING_LOST, edges.track_id, flaw)
        error = self._calibration_error
        if error is not None and error.clock > 0.0 and not np.isfinite(pose.motion).all():
            return self._without(edges.stamp_ns, GapStatus.OUT_OF_SYNC, edges.track_id, UNKNOWN_MOTION)
        begins = self._track is None or not self._track.continues_with(edges, pose)
        if self._leg is not None and not begins and self._leg_moved(self._leg, pose):
            self._track = None
            return self._without(edges.stamp_ns, GapStatus.JOINT_MOVED, edges.track_id, LEG_MOVED)
        if self._track is None or begins:
            self._leg_at_first = self._leg.pose if self._leg is not None else None
            if error is None and edges.camera_errors.shape[-1]:
                error = CalibrationError(np.zeros((6, 6)), 0.0)  # of the camera alone, which the edges tell
            self._track = Track(edges.track_id, pose.frame_id, self.parameters, error)
        try:
            estimate = self._track.add(edges, pose)
        except (MeasurementError, ArithmeticError, ValueError):
            self._track = None
            return self._without(edges.stamp_ns, GapStatus.UNKNOWN, edges.track_id, NO_NUMBERS)
        travel_left = self._advice_task.travel_left(self._track.situation)
        return self._count(replace(estimate, translation_to_target=travel_left))

    def _leg_moved(self, leg: LegBody, pose: LensPose) -> bool:
        """Whether the leg body has moved too far within the track, at the place of the lens."""
        before = self._leg_at_first
        return before is not None and leg.moved_since(before, pose.position) > self.parameters.leg_motion

    def _situation(self) -> Situation | None:
        """What advice can be based on now."""
        return self._track.situation if self._track is not None else None

    def _without(self, stamp_ns: int, status: GapStatus, track_id: int, reason: str) -> GapEstimate:
        """An estimate that says why there is no number."""
        return self._count(
            GapEstimate(
                stamp_ns,
                self._frame_id,
                status,
                track_id=track_id,
                interval=self.parameters.interval,
                reason=reason,
            )
        )

    def _count(self, estimate: GapEstimate) -> GapEstimate:
        self.latest = estimate
        self.counts[estimate.status.name] += 1
        if estimate.reason:
            self.counts[f"{estimate.status.name}: {estimate.reason}"] += 1
        return estimate
