"""The core of uncertainty_node: gap edges, lens poses and the leg body in; gap estimates and advice out."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from knee_gap_core.conversions.edge_messages import edges_from_message
from knee_gap_core.conversions.pose_messages import lens_pose_from_message
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Blank, Health, InputTopic, Notice, Outcome, Output, OutputTopic, Qos
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_uncertainty.estimation import messages
from knee_gap_uncertainty.estimation.acceptance import Reason
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.motion_advice.advice_task import AdvicePace
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters

NODE = "uncertainty_node"
GAP_EDGES = InputTopic("gap_edges", "knee_gap_msgs/msg/GapEdges", Qos.RESULT, needed=True)
# Before the pose, because it is published just before the pose that it belongs to.
SCOPE_ROTATION = InputTopic("scope_rotation", "knee_gap_msgs/msg/ScopeRotation", Qos.RESULT)
SCOPE_POSE = InputTopic("scope_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", Qos.RESULT, needed=True)
LEG_BODY = InputTopic("leg_body/pose", "geometry_msgs/msg/PoseStamped", Qos.TRACKER, from_driver=True)
CALIBRATION = InputTopic("scope_calibration", "knee_gap_msgs/msg/ScopeCalibration", Qos.LATCHED_BY_SEVERAL)
GAP = OutputTopic("gap", "knee_gap_msgs/msg/GapEstimate", Qos.DEADLINE)
GAP_PROFILE = OutputTopic("gap_profile", "knee_gap_msgs/msg/GapProfile", Qos.RESULT)
MOTION_ADVICE = OutputTopic("motion_advice", "knee_gap_msgs/msg/MotionAdvice", Qos.RESULT)
# Plain numbers, by the field of the estimate that each repeats.
NUMBERS = {
    name: OutputTopic(topic, "std_msgs/msg/Float64", Qos.RESULT)
    for topic, name in (("gap/min", "gap_min"), ("gap/max", "gap_max"), ("gap/snr", "snr"))
}


class UncertaintyCore:
    """Turns messages into those that uncertainty_node publishes, by a `GapEstimator`.

    A live node gives its `clock` [ns], by which estimates that leave too late lose their numbers, and the
    `pace` of the work on advice.
    """

    parameters: tuple[type, ...] = (EstimatorParameters, AdviceParameters)

    def __init__(
        self,
        estimator: GapEstimator,
        blank: Blank,
        *,
        clock: Callable[[], int] | None = None,
        pace: AdvicePace | None = None,
    ) -> None:
        self.estimator = estimator
        self._blank = blank
        self._clock = clock
        self._pace = pace

    @property
    def inputs(self) -> tuple[InputTopic, ...]:
        """The leg body is received if its motion is limited."""
        leg = [LEG_BODY] if self.estimator.parameters.leg_motion > 0.0 else []
        return (GAP_EDGES, SCOPE_ROTATION, SCOPE_POSE, *leg, CALIBRATION)

    @property
    def outputs(self) -> tuple[OutputTopic, ...]:
        """All topics."""
        return (GAP, GAP_PROFILE, MOTION_ADVICE, *NUMBERS.values())

    def begin(self, now_ns: int) -> Iterator[Outcome]:
        """An estimate without numbers, so that a deadline can fire from now on."""
        return self._published(self.estimator.begin(now_ns))

    def take(self, topic: str, message: Any, now_ns: int, queued_ns: int = 0) -> list[Outcome]:
        """Receive a message; return the estimates that it made possible."""
        estimator = self.estimator
        if topic == GAP_EDGES.topic:
            edges = edges_from_message(message)
            return list(self._published(estimator.add_edges(edges, now_ns, queued_ns)))
        if topic == SCOPE_POSE.topic:
            pose = lens_pose_from_message(message)
            return list(self._published(estimator.add_pose(pose, now_ns, queued_ns)))
        if topic == SCOPE_ROTATION.topic:
            rotation = messages.rotation_from_message(message)
            return list(self._published(estimator.add_rotation(rotation, now_ns)))
        if topic == LEG_BODY.topic:
            estimator.add_leg_pose(messages.leg_pose_from_message(message))
            return []
        estimator.add_calibration(messages.calibration_from_message(message))
        flaw = estimator.calibration_flaw
        return [Notice(flaw, flaw, is_error=True)] if flaw else []

    def ready(self, now_ns: int) -> Iterator[Outcome]:
        """Estimates that must not wait any longer, and advice that has become ready."""
        if self._pace is None:
            yield from self._published(self.estimator.advance(now_ns))
        else:
            began = time.perf_counter()
            yield from self._published(self.estimator.advance(now_ns, self._pace.next()))
            self._pace.spent(time.perf_counter() - began)
        while self.estimator.advice:
            advice = self.estimator.advice.popleft()
            message = self._blank(MOTION_ADVICE.msgtype)
            messages.fill_motion_advice(message, advice, self.estimator.advice_parameters)
            yield Output(MOTION_ADVICE.topic, message, advice.stamp_ns)

    def finish(self, now_ns: int) -> Iterator[Outcome]:
        """Estimates of the images for which no pose will come any more."""
        wait_ns = round(self.estimator.parameters.max_pose_wait * NANOSECONDS)
        return self._published(self.estimator.advance(now_ns + wait_ns + 1))

    def recover(self, fault: Fault) -> list[Outcome]:
        """Reset the estimator; an estimate without numbers for the image that raised."""
        return list(self._published(self.estimator.recover(fault.reason)))

    def health(self) -> Health:
        """Status of the latest estimate, and the count of each status and reason."""
        latest, reported = self.estimator.latest, self.estimator.calibrations
        rows: dict[str, object] = {
            f"calibration of {node}": calibration.hash or "none" for node, calibration in reported.items()
        }
        rows.update(self.estimator.counts)
        if latest is None:
            return False, self.estimator.calibration_flaw or Reason.NOTHING_YET.value, rows
        well = latest.status is GapStatus.VALID
        return well, self.estimator.calibration_flaw or latest.reason or latest.status.name, rows

    def _published(self, estimates: Sequence[GapEstimate]) -> Iterator[Outcome]:
        """Each estimate; plain numbers and the profile only where it is VALID."""
        valid = set()
        for measured in estimates:
            estimate = self._leaving(measured)
            message = messages.fill_gap_estimate(self._blank(GAP.msgtype), estimate)
            yield Output(GAP.topic, message, estimate.stamp_ns)
            if estimate.status is GapStatus.VALID:
                valid.add(estimate.stamp_ns)
                for name, topic in NUMBERS.items():
                    number = self._blank(topic.msgtype)
                    number.data = float(getattr(estimate, name))
                    yield Output(topic.topic, number, estimate.stamp_ns)
            elif estimate.rejection is not None:
                yield Notice(estimate.rejection.reason, f"{estimate.status.name}: {estimate.reason}")
        while self.estimator.profiles:
            profile = self.estimator.profiles.popleft()
            if profile.stamp_ns in valid:
                message = messages.fill_gap_profile(self._blank(GAP_PROFILE.msgtype), profile)
                yield Output(GAP_PROFILE.topic, message, profile.stamp_ns)

    def _leaving(self, estimate: GapEstimate) -> GapEstimate:
        return estimate if self._clock is None else self.estimator.leaving(estimate, self._clock())
