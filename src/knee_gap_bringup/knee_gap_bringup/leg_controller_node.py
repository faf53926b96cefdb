"""leg_controller_node: an example subscriber of gap that moves nothing unless the gap is known."""

import time
from collections.abc import Mapping, Sequence

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from knee_gap_bringup.leg_control import Action, Command, Estimate, LegControl, LegParameters
from knee_gap_msgs.msg import GapEstimate
from knee_gap_node.base_node import RESULT_QOS, BaseNode, run

# What is said where points or lens are not seen; a leg that opens is known to move, and may well go on.
BLIND = (
    GapEstimate.STATUS_UNKNOWN,
    GapEstimate.STATUS_NO_EDGES,
    GapEstimate.STATUS_TRACKING_LOST,
    GapEstimate.STATUS_OUT_OF_SYNC,
)


class LegControllerNode(BaseNode):
    """Converts, decides, publishes the rate at which the joint should open [m/s]."""

    def __init__(self) -> None:
        super().__init__("leg_controller_node", health=self.health)
        self._control = LegControl(self.declare(LegParameters))
        self.refuse_unknown_parameters()
        self._command = Command(Action.HOLD, 0.0, "no estimate received yet")
        self._measure_anew = self.create_client(Trigger, "start_anew")
        self._rate = self.create_publisher(Float64, "leg/opening_rate", RESULT_QOS)
        qos = QoSProfile(
            depth=1,
            reliability=RESULT_QOS.reliability,
            deadline=Duration(nanoseconds=int(self._control.parameters.deadline * 1e9)),
        )
        self.create_subscription(
            GapEstimate,
            "gap",
            self.on_gap,
            qos,
            event_callbacks=SubscriptionEventCallbacks(deadline=self.on_silence),
        )

    def on_gap(self, message: GapEstimate) -> None:
        """Decide on one estimate."""
        valid = message.status == GapEstimate.STATUS_VALID
        # Not by rclpy's Time, which raises at a stamp before 1970.
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        age = (self.get_clock().now().nanoseconds - stamp_ns) / 1e9
        blind = message.status in BLIND
        estimate = Estimate(valid, message.track_id, age, message.gap_min, message.gap_max, blind)
        self.command(self._control.on_estimate(estimate, time.monotonic()))

    def on_silence(self, _event: object) -> None:
        """Hold the leg: whoever measures the gap is late or dead."""
        self.command(self._control.on_silence(time.monotonic()))

    def command(self, command: Command) -> None:
        """Publish a command, and say so when the action changes."""
        if command.action is not self._command.action:
            self.get_logger().info(f"{command.action}: {command.reason}")
        self._command = command
        if command.measure_anew:
            # Without an answer the leg is held: the old track is not believed any more.
            self._measure_anew.call_async(Trigger.Request())
        self._rate.publish(Float64(data=command.opening_rate))

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """The present action and its reason."""
        return True, f"{self._command.action}: {self._command.reason}", {}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(LegControllerNode, argv)
