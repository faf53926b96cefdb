"""uncertainty_node: gap_edges and scope_pose in; gap, its bounds, and motion_advice out."""

import time
from collections.abc import Mapping, Sequence

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64

from knee_gap_core.node.base_node import LATCHED_QOS, RESULT_QOS, TRACKER_QOS, BaseNode, run
from knee_gap_core.node.seam import Fault
from knee_gap_core.values import gap_estimate
from knee_gap_core.values.edge_messages import edges_from_message
from knee_gap_msgs.msg import GapEdges, GapEstimate, GapProfile, MotionAdvice, ScopeCalibration, ScopeRotation
from knee_gap_uncertainty import messages
from knee_gap_uncertainty.acceptance import Reason
from knee_gap_uncertainty.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.inputs.delays import ContinuedClock
from knee_gap_uncertainty.motion_advice.advice_task import AdvicePace
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters
from knee_gap_uncertainty.warm_up import warm_up

# A controller that asks for this deadline or a longer one is told by the middleware when the node is dead.
GAP_DEADLINE = Duration(nanoseconds=100_000_000)
# How often time is let pass when no message does it [s].
TICK = 0.02


class UncertaintyNode(BaseNode):
    """Converts, calls the estimator, publishes."""

    def __init__(self) -> None:
        super().__init__("uncertainty_node", health=self.health)
        self._advice_parameters = self.declare(AdviceParameters)
        self._estimator = GapEstimator(self.declare(EstimatorParameters), self._advice_parameters)
        self.refuse_unknown_parameters()
        gap_qos = QoSProfile(
            depth=RESULT_QOS.depth, reliability=RESULT_QOS.reliability, deadline=GAP_DEADLINE
        )
        self._gap = self.create_publisher(GapEstimate, "gap", gap_qos)
        self._numbers = {
            name: self.create_publisher(Float64, f"gap/{topic}", RESULT_QOS)
            for topic, name in (("min", "gap_min"), ("max", "gap_max"), ("snr", "snr"))
        }
        self._advice = self.create_publisher(MotionAdvice, "motion_advice", RESULT_QOS)
        self._profile = self.create_publisher(GapProfile, "gap_profile", RESULT_QOS)
        self._continued_clock = ContinuedClock()
        # Said before the first image comes, so that a deadline can fire from now on.
        self.publish(self._estimator.begin(self.now_ns()))
        # Compiled before the first image, so that its estimate is not late.
        warm_up()
        self.create_subscription(GapEdges, "gap_edges", self.on_edges, RESULT_QOS)
        # What waits is taken in this order: the turn that is told with a pose before the pose.
        self.create_subscription(ScopeRotation, "scope_rotation", self.on_rotation, RESULT_QOS)
        self.create_subscription(PoseWithCovarianceStamped, "scope_pose", self.on_pose, RESULT_QOS)
        if self._estimator.parameters.leg_motion > 0.0:
            self.create_subscription(PoseStamped, "leg_body/pose", self.on_leg_pose, TRACKER_QOS)
        self.watch_input("gap_edges")
        self.watch_input("scope_pose")
        # Latched by two nodes: of each the last word is wanted.
        calibration_qos = QoSProfile(
            depth=8, reliability=LATCHED_QOS.reliability, durability=LATCHED_QOS.durability
        )
        self.create_subscription(ScopeCalibration, "scope_calibration", self.on_calibration, calibration_qos)
        self._pace = AdvicePace(TICK)
        # By the steady clock: silence must be reported when /clock has stopped too.
        self._tick = self.create_timer(TICK, self.on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_tick(self) -> None:
        """Let time pass: estimates that must not wait any longer, and advice that has become ready."""
        began = time.perf_counter()
        self.publish(self._estimator.advance(self.now_ns(), self._pace.next()))
        self._pace.spent(time.perf_counter() - began)
        while self._estimator.advice:
            advice = self._estimator.advice.popleft()
            message = messages.fill_motion_advice(MotionAdvice(), advice, self._advice_parameters)
            self._advice.publish(message)

    def on_edges(self, message: GapEdges) -> None:
        """Estimate at an image."""
        self.publish(self._estimator.add_edges(edges_from_message(message), self.now_ns()))

    def on_pose(self, message: PoseWithCovarianceStamped, info: Mapping[str, int | None]) -> None:
        """Take a lens pose, which may complete images that waited for it."""
        pose, queued_ns = messages.pose_from_message(message), self.queued_ns(info)
        self.publish(self._estimator.add_pose(pose, self.now_ns(), queued_ns))

    def queued_ns(self, info: Mapping[str, int | None]) -> int:
        """How long a message lay in this node's queue: where poses and images lie alike, both are late.

        Zero by a bag's clock, which tells nothing of it.
        """
        received_ns = info.get("received_timestamp")
        if not received_ns or self.get_clock().ros_time_is_active:
            return 0
        return max(time.time_ns() - received_ns, 0)

    def on_leg_pose(self, message: PoseStamped) -> None:
        """Take a pose of a body fixed to the leg, which must not move within a track."""
        self._estimator.add_leg_pose(messages.leg_pose_from_message(message))

    def on_rotation(self, message: ScopeRotation) -> None:
        """Take how far the scope is turned, which may complete images that waited for it."""
        self.publish(self._estimator.add_rotation(messages.rotation_from_message(message), self.now_ns()))

    def on_calibration(self, message: ScopeCalibration) -> None:
        """Take what a node says of its calibration of the scope."""
        self._estimator.add_calibration(messages.calibration_from_message(message))
        if flaw := self._estimator.calibration_flaw:
            self.get_logger().error(flaw)

    def now_ns(self) -> int:
        """Time by which waiting is measured; with use_sim_time the bag's, so slow replay waits longer.

        It goes on when /clock has stopped: whoever waits for an image or a pose then would wait for ever.
        """
        return self._continued_clock.read(int(self.get_clock().now().nanoseconds), time.monotonic_ns())

    def publish(self, estimates: Sequence[gap_estimate.GapEstimate]) -> None:
        """Publish each estimate; the plain numbers only where they are valid."""
        valid = set()
        for measured in estimates:
            estimate = self._estimator.leaving(measured, self.now_ns())
            self._gap.publish(messages.fill_gap_estimate(GapEstimate(), estimate))
            if estimate.status is gap_estimate.GapStatus.VALID:
                valid.add(estimate.stamp_ns)
                for name, publisher in self._numbers.items():
                    publisher.publish(Float64(data=float(getattr(estimate, name))))
            elif estimate.rejection is not None:
                self.log_once(estimate.rejection.reason, f"{estimate.status.name}: {estimate.reason}")
        while self._estimator.profiles:
            profile = self._estimator.profiles.popleft()
            if profile.stamp_ns in valid:
                self._profile.publish(messages.fill_gap_profile(GapProfile(), profile))

    def recover(self, fault: Fault) -> None:
        """Start the estimator afresh, and say of the image that raised that nothing is known of it."""
        self.publish(self._estimator.recover(fault.reason))

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """Status of the latest estimate, and how often each status and reason came."""
        latest, reported = self._estimator.latest, self._estimator.calibrations
        counts: dict[str, object] = {
            f"calibration of {node}": calibration.hash or "none" for node, calibration in reported.items()
        }
        counts.update(self._estimator.counts)
        if latest is None:
            return False, self._estimator.calibration_flaw or Reason.NOTHING_YET.value, counts
        well = latest.status is gap_estimate.GapStatus.VALID
        return well, self._estimator.calibration_flaw or latest.reason or latest.status.name, counts


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(UncertaintyNode, argv)
