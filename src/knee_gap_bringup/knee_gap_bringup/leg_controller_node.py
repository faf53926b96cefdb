"""leg_controller_node: an example subscriber of gap that commands no motion unless the gap is known."""

import time
from collections.abc import Callable, Mapping, Sequence

from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger

from knee_gap_bringup.leg_control import TICK, Action, Command, Estimate, LegControl, LegParameters, hold
from knee_gap_core.live.base_node import RESULT_QOS, BaseNode, run
from knee_gap_msgs.msg import GapEstimate

# Frame of the command: its x axis is the direction in which the joint opens.
LEG_FRAME = "leg"


class LegControllerNode(BaseNode):
    """Publishes the rate at which the joint should open [m/s].

    The command is a TwistStamped, as for ROS's velocity controllers: `linear.x` along the opening of the
    joint, with the present stamp, repeated every `TICK`. Hold the leg if no command is received for 0.1 s.
    """

    def __init__(self) -> None:
        super().__init__("leg_controller_node", health=self.health)
        self._control = LegControl(self.declare(LegParameters), time.monotonic())
        self.refuse_unknown_parameters()
        self._command = hold("no estimate received yet")
        self._measure_again = self.create_client(Trigger, "restart")
        self._requested: Future[Trigger.Response] | None = None
        self._rate = self.create_publisher(TwistStamped, "leg/command", RESULT_QOS)
        self.create_service(Trigger, "~/reset", self.on_reset)
        qos = QoSProfile(
            # Deep enough that no message within a step is dropped for a newer one.
            depth=RESULT_QOS.depth,
            reliability=RESULT_QOS.reliability,
            deadline=Duration(nanoseconds=int(self._control.parameters.deadline * 1e9)),
        )
        self._subscription = self.create_subscription(
            GapEstimate,
            "gap",
            self.on_gap,
            qos,
            event_callbacks=SubscriptionEventCallbacks(deadline=self.on_silence),
        )
        # On the steady clock: the leg must not keep moving if a bag's clock stops.
        self._tick = self.create_timer(TICK, self.on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_gap(self, message: GapEstimate, info: Mapping[str, int | None]) -> None:
        """Decide on one estimate."""

        def decide() -> Command:
            sequence = info.get("publication_sequence_number")
            estimate = Estimate.from_message(message, self.get_clock().now().nanoseconds, sequence)
            decided = self._control.on_estimate(estimate, time.monotonic())
            return self._control.on_publishers(self.publishers(), time.monotonic()) or decided

        self.command(decide)

    def on_silence(self, _event: object) -> None:
        """Hold the leg: the estimate is late, or its node has died."""
        self.command(lambda: self._control.on_silence(time.monotonic()))

    def on_tick(self) -> None:
        """Advance the time, check the publishers of the gap, and repeat the command."""

        def decide() -> Command:
            fault = self._control.on_publishers(self.publishers(), time.monotonic())
            return fault or self._control.on_time(time.monotonic()) or self._command

        self.command(decide)

    def on_reset(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Clear a fault on a person's request; the gap is then measured again."""
        fault = self._control.fault
        answer.message = self._control.reset(time.monotonic())
        answer.success = not answer.message
        if answer.success:
            answer.message = f"reset after: {fault}" if fault else "there was no fault"
        self.get_logger().info(answer.message)
        return answer

    def publishers(self) -> frozenset[str]:
        """Discovered publishers of the gap, by the middleware's ids."""
        known = self.get_publishers_info_by_topic(self._subscription.topic_name)
        return frozenset(bytes(one.endpoint_gid).hex() for one in known)

    def command(self, decide: Callable[[], Command]) -> None:
        """Publish a command, and log it if the action or its reason changes."""
        try:
            command = decide()
        except Exception as error:  # the leg is held whatever went wrong
            command = self._control.on_fault(f"the controller failed: {error!r}", time.monotonic())
        if command.measure_again:
            # Without a response the leg is held, and the core requests it again: the old track is not used.
            if self._requested is not None and not self._requested.done():
                self._measure_again.remove_pending_request(self._requested)
            self._requested = self._measure_again.call_async(Trigger.Request())
        self.log(command)
        # A repeated command repeats no request.
        self._command = command._replace(measure_again=False)
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = LEG_FRAME
        message.twist.linear.x = command.opening_rate
        self._rate.publish(message)

    def log(self, command: Command) -> None:
        """Log changes of the command; a fault as an error."""
        if command.action is self._command.action and (
            command.reason == self._command.reason or command.action is Action.OPEN
        ):
            return
        words = f"{command.action}: {command.reason}"
        if self._control.fault:
            self.get_logger().error(f"{words} (call {self.get_name()}/reset)")
        elif command.action is not self._command.action:
            self.get_logger().info(words)

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """The present action and its reason."""
        return not self._control.fault, f"{self._command.action}: {self._command.reason}", {}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(LegControllerNode, argv)
