"""The estimator: posed observations of the two edges go in, estimates with bounds come out.

The live node, the offline processing of a bag and the simulation run this same object; only what feeds it
differs. It waits for nothing and reads no clock: its caller states when each message arrived, and
calls `advance` when time passes without one.
"""

from collections import Counter, deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.errors import MeasurementError
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_uncertainty.estimation.acceptance import Facts, Verdict, judge
from knee_gap_uncertainty.estimation.gap_track import Track
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.inputs.delays import DelayFloor
from knee_gap_uncertainty.inputs.leg_body import LegBody
from knee_gap_uncertainty.inputs.pose_buffer import PoseBuffer, PoseRefusal
from knee_gap_uncertainty.inputs.scope_rotations import RotationRefusal, ScopeRotation, ScopeRotations
from knee_gap_uncertainty.inputs.silence import Silence
from knee_gap_uncertainty.instrument_gap.gap_profile import GapProfile
from knee_gap_uncertainty.motion_advice.advice_task import PIECES, AdviceTask
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters, MotionAdvice, Situation
from knee_gap_uncertainty.scope_calibration.scope_calibration import (
    ScopeCalibration,
    contradiction,
    shared_error,
)

# The most images that may wait for a pose: at 60 Hz over two seconds, far beyond any allowed wait.
MOST_PENDING = 128
# Edges that lay in a queue for longer than the first time were not taken promptly: poses may lie in a queue
# as well, and are taken within the second.
PROMPT_NS, QUEUES_NS = 2_000_000, 4_000_000
# Of calibrations: what arrives from a network must not grow without end.
MOST_NODES = 8
# Advice, and profiles, that nobody has taken yet.
MOST_ADVICE = 16


class Pending(NamedTuple):
    """Edges that wait for the lens pose after them, when they arrived [ns], and why they cannot be used.

    `queued`: they had lain in a queue, and poses may lie in one.
    """

    edges: GapEdges
    arrival_ns: int
    flaw: str = ""
    queued: bool = False


class GapEstimator:
    """Fuses edges and lens poses into one estimate an image, in the order of the images.

    Advice on motion is made while time passes and is taken from `advice`; `profiles` are those of the images
    that show more sections of the opening.
    """

    def __init__(
        self, parameters: EstimatorParameters | None = None, advice: AdviceParameters | None = None
    ) -> None:
        self.parameters = parameters or EstimatorParameters()
        self.advice: deque[MotionAdvice] = deque(maxlen=MOST_ADVICE)
        self.profiles: deque[GapProfile] = deque(maxlen=MOST_ADVICE)
        self._advice_task = AdviceTask(advice)
        self.counts: Counter[str] = Counter()
        self.latest: GapEstimate | None = None
        self._poses = PoseBuffer(max_pose_age=self.parameters.max_pose_age)
        self._turns = ScopeRotations(self.parameters.max_pose_age)
        # Whether a rotation was ever reported: it is followed then, and an image without one is of an unknown
        # scope.
        self._rotation_reported = False
        self._pending: deque[Pending] = deque()
        self._track: Track | None = None
        # Until a track shows that the tracked body does not creep, and again after one that motion has ended.
        self._suspects_creep = True
        self._leg = LegBody(self.parameters.max_pose_age) if self.parameters.leg_motion > 0.0 else None
        # Where the leg body was when the track began.
        self._leg_at_first: LensPose | None = None
        self.calibrations: dict[str, ScopeCalibration] = {}
        self.calibration_flaw = ""
        self._calibration_error = shared_error((), self.parameters)
        self._frame_id = ""
        # Whether stamps are compared with the caller's clock: live they are of the same time.
        self._is_live = False
        # By how much the clock was ahead of the stamps of the latest poses: what an image's delay is held to.
        self._delays = DelayFloor()
        self._last_edges: Pending | None = None
        self._silence = Silence(self.parameters.max_edges_silence)
        self._pose_silence = Silence(self.parameters.max_pose_wait)
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
            delay_ns = arrival_ns - queued_ns - pose.stamp_ns
            near = abs(delay_ns) <= self.parameters.max_clock_offset * NANOSECONDS
            self._delays.take(delay_ns, arrival_ns, is_live=self._is_live and near)
            self._pose_silence.add(pose.stamp_ns, arrival_ns)
        return self._resolve(arrival_ns)

    def add_rotation(self, reported: ScopeRotation, arrival_ns: int) -> list[GapEstimate]:
        """Take how far the scope is turned in its camera head; return the estimates that it made possible."""
        self._turn_clock(arrival_ns)
        if not self._rotation_is_followed():
            # The views before had none.
            self._track = None
        self._rotation_reported = True
        if refusal := self._turns.add(reported):
            self.counts[f"scope_rotation refused: {refusal.value}"] += 1
        return self._resolve(arrival_ns)

    def add_leg_pose(self, pose: LensPose) -> None:
        """Take a pose of the leg body; it is without effect where `leg_motion` is 0."""
        if self._leg is None:
            return
        refusal = self._leg.add(pose)
        if refusal is not None:
            self.counts[f"leg body refused: {refusal.value}"] += 1

    def add_calibration(self, reported: ScopeCalibration) -> None:
        """Add the calibration that a node reports.

        If nodes contradict each other, or report an impossible error, nothing is valid.
        """
        known = self.calibrations.get(reported.node)
        if known is None and len(self.calibrations) == MOST_NODES:
            self.counts["calibrations of more nodes than there can be"] += 1
            self.calibration_flaw = f"more than {MOST_NODES} nodes state a calibration of the scope"
            return
        self.calibrations[reported.node] = reported
        flaws = [contradiction(self.calibrations), *(one.flaw() for one in self.calibrations.values())]
        self.calibration_flaw = next((flaw for flaw in flaws if flaw), "")
        self._calibration_error = shared_error(self.calibrations.values(), self.parameters)
        if known is None or not reported.says_the_same_as(known):
            # Views by another calibration are not comparable with those before.
            self._track = None

    def add_edges(self, edges: GapEdges, arrival_ns: int, queued_ns: int = 0) -> list[GapEstimate]:
        """Take the edges of one image, which had lain in a queue; return the estimates that are ready."""
        self._turn_clock(arrival_ns)
        last = self._last_edges
        if last is not None and edges.stamp_ns == last.edges.stamp_ns:
            # The image was answered; its repetition is no new one, nor an end of silence.
            self.counts["images with the stamp of the one before"] += 1
            return self._resolve(arrival_ns)
        if last is not None and edges.stamp_ns < last.edges.stamp_ns:
            self.counts["stamps ran backwards"] += 1
            self._pending.clear()
            self._delays.clear()
            self._track = None
        self._last_edges = Pending(edges, arrival_ns)
        self._silence.add(edges.stamp_ns, arrival_ns)
        if len(self._pending) == MOST_PENDING:
            self.counts["images dropped while waiting for poses"] += 1
            self._pending.popleft()
        self._pending.append(Pending(edges, arrival_ns, edges.flaw(), queued_ns > PROMPT_NS))
        return self._resolve(arrival_ns)

    def advance(self, now_ns: int, advice_pieces: int = PIECES) -> list[GapEstimate]:
        """Let time pass; return the estimates that must not wait any longer, and what silence means.

        `advice_pieces`: how much work on advice may be done meanwhile.
        """
        self._turn_clock(now_ns)
        try:
            if advice := self._advice_task.turn(self._situation(), advice_pieces):
                self.advice.append(advice)
        except (MeasurementError, ArithmeticError, ValueError):
            # Advice that cannot be calculated costs no estimate.
            self._advice_task = AdviceTask(self._advice_task.parameters)
            self.counts["advice that could not be calculated"] += 1
        estimates = self._resolve(now_ns)
        if self._pending or (self._last_edges is None and not self._is_live):
            return estimates
        if self._silence.is_due(now_ns):
            estimates.append(self._silent(now_ns))
        return estimates

    def begin(self, now_ns: int) -> list[GapEstimate]:
        """Begin to measure live: stamps are held to the clock, and silence is reported from now on."""
        self._is_live = True
        self._now_ns = now_ns
        return [self._silent(now_ns)]

    def leaving(self, estimate: GapEstimate, now_ns: int) -> GapEstimate:
        """An estimate as it leaves at a time [ns]: without numbers if its image is too long ago by then."""
        if estimate.status is not GapStatus.VALID:
            return estimate
        delay = self._delays.excess(now_ns - estimate.stamp_ns)
        verdict = judge(Facts(self.parameters, delay=delay))
        return self._without(estimate.stamp_ns, estimate.track_id, verdict) if verdict else estimate

    def _silent(self, now_ns: int) -> GapEstimate:
        """The estimate that reports that no image comes."""
        self._silence.report(now_ns)
        last = self._last_edges
        # The only stamp that is not an image's: no image came, and the statement needs a time.
        stamp_ns = now_ns if last is None else last.edges.stamp_ns + now_ns - last.arrival_ns
        verdict = judge(Facts(self.parameters, is_silent=True, is_first_awaited=last is None))
        assert verdict is not None
        return self._without(max(stamp_ns, 0), 0, verdict)

    def recover(self, reason: str) -> list[GapEstimate]:
        """Reset after an exception: end the track and forget the poses; calibrations stay.

        Returns the estimate reported for the image that was due, if one waited.
        """
        self._track = None
        self._poses.clear()
        self._advice_task = AdviceTask(self._advice_task.parameters)
        if not self._pending:
            return []
        edges = self._pending.popleft().edges
        verdict = judge(Facts(self.parameters, fault=reason))
        assert verdict is not None
        return [self._without(edges.stamp_ns, edges.track_id, verdict)]

    def break_input(self, topic: str) -> None:
        """End the track and forget the poses: the next message of a topic does not continue those before.

        Two publishers, or one that was started again, are then never measured with together.
        """
        self.counts[f"messages of {topic} that do not continue those before"] += 1
        self._track = None
        self._poses.clear()

    def _turn_clock(self, now_ns: int) -> None:
        """Take the time; where it runs backwards (a bag that starts again) nothing waits any longer."""
        if now_ns < self._now_ns:
            self.counts["clock ran backwards"] += 1
            self._pending.clear()
            self._delays.clear()
            if self._last_edges is not None:
                self._last_edges = self._last_edges._replace(arrival_ns=now_ns)
                self._silence.restart(now_ns)
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
        facts = Facts(
            self.parameters,
            edges=edges,
            edges_flaw=pending.flaw,
            clock_offset=1e-9 * (pending.arrival_ns - edges.stamp_ns) if self._is_live else np.nan,
            delay=self._delays.excess(pending.arrival_ns - edges.stamp_ns),
            pose=self._poses.at(edges.stamp_ns),
            turn=self._turns.at(edges.stamp_ns) if self._rotation_is_followed() else 0.0,
        )
        awaited = facts.pose is PoseRefusal.NOT_YET or facts.turn is RotationRefusal.NOT_YET
        may_wait = now_ns - pending.arrival_ns <= self._longest_wait_ns(pending, now_ns)
        if awaited and may_wait and not facts.edges_flaw:
            return None
        if verdict := judge(facts):
            return self._without(edges.stamp_ns, edges.track_id, verdict)
        assert isinstance(facts.pose, LensPose)
        assert not isinstance(facts.turn, RotationRefusal)
        return self._measure(facts, edges, replace(facts.pose, scope_rotation=facts.turn))

    def _longest_wait_ns(self, pending: Pending, now_ns: int) -> float:
        """How long edges may wait for their pose [ns]: poses that do not come any more are not awaited."""
        longest = self.parameters.max_pose_wait * NANOSECONDS
        if self._pose_silence.is_due(now_ns):
            return min(QUEUES_NS, longest) if pending.queued else -1.0
        return longest

    def _rotation_is_followed(self) -> bool:
        """Whether the rotation of the scope in its camera head is reported, or announced."""
        return self._rotation_reported or any(one.rotation_followed for one in self.calibrations.values())

    def _measure(self, facts: Facts, edges: GapEdges, pose: LensPose) -> GapEstimate:
        """Estimate from the edges and their lens pose, within the track that they belong to."""
        if self.calibration_flaw:
            self._track = None
        if self._track is not None and self._track.breaks_at(pose):
            self._track = None
            self.counts[f"tracks ended: {self._poses.discontinuity}"] += 1
        begins = self._track is None or not self._track.continues_with(edges, pose)
        facts = replace(
            facts,
            calibration_flaw=self.calibration_flaw,
            leg_flaw=self._leg.flaw(edges.stamp_ns, pose.frame_id) if self._leg is not None else "",
            needs_motion=self._calibration_error.clock > 0.0,
        )
        if self._leg is not None and not facts.leg_flaw and not begins:
            facts = replace(facts, leg_moved=self._leg_moved(self._leg, pose))
        if verdict := judge(facts):
            if facts.leg_moved:
                self._track = None
            return self._without(edges.stamp_ns, edges.track_id, verdict)
        if self._track is None or begins:
            self._leg_at_first = self._leg.pose if self._leg is not None else None
            columns = edges.camera_errors.shape[-1]
            self._track = Track(
                edges.track_id,
                pose.frame_id,
                self.parameters,
                self._calibration_error,
                columns,
                self._suspects_creep,
            )
        try:
            estimate = self._track.add(edges, pose)
            self._suspects_creep = self._track.suspects_creep
        except (MeasurementError, ArithmeticError, ValueError) as error:
            self._track = None
            verdict = judge(Facts(self.parameters, error=error))
            assert verdict is not None
            return self._without(edges.stamp_ns, edges.track_id, verdict)
        if self._track.profile is not None:
            self.profiles.append(self._track.profile)
        situation = self._track.situation
        known = situation is not None and situation.stamp_ns == edges.stamp_ns
        travel_left = self._advice_task.travel_left(situation) if known else float("nan")
        return self._count(replace(estimate, translation_to_target=travel_left))

    def _leg_moved(self, leg: LegBody, pose: LensPose) -> bool:
        """Whether the leg body has moved too far within the track, at the place of the lens."""
        before = self._leg_at_first
        return before is not None and leg.moved_since(before, pose.position) > self.parameters.leg_motion

    def _situation(self) -> Situation | None:
        """What advice can be based on now."""
        return self._track.situation if self._track is not None else None

    def _without(self, stamp_ns: int, track_id: int, verdict: Verdict) -> GapEstimate:
        """An estimate without numbers, with the reason."""
        return self._count(
            GapEstimate(
                stamp_ns,
                self._frame_id,
                verdict.status,
                track_id=track_id,
                interval=self.parameters.interval,
                rejection=verdict.rejection,
            )
        )

    def _count(self, estimate: GapEstimate) -> GapEstimate:
        self.latest = estimate
        self.counts[estimate.status.name] += 1
        if estimate.rejection is not None:
            self.counts[f"{estimate.status.name}: {estimate.rejection.reason.value}"] += 1
        return estimate
