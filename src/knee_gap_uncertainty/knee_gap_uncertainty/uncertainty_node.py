"""uncertainty_node: gap_edges and scope_pose in; gap, its bounds, and motion_advice out."""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.clock import Clock, ClockType

from knee_gap_core.live.base_node import run
from knee_gap_core.live.wired_node import WiredNode, blank
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimation.uncertainty_core import (
    GAP_EDGES,
    NODE,
    SCOPE_POSE,
    SCOPE_ROTATION,
    UncertaintyCore,
)
from knee_gap_uncertainty.estimation.warm_up import warm_up
from knee_gap_uncertainty.inputs.delays import ContinuedClock
from knee_gap_uncertainty.inputs.message_sequence import MessageSequence
from knee_gap_uncertainty.motion_advice.advice_task import AdvicePace

# How often time is let pass when no message does it [s].
TICK = 0.01
# Topics of one publisher each, whose messages continue one another.
CONTINUED = (GAP_EDGES.topic, SCOPE_POSE.topic, SCOPE_ROTATION.topic)


class UncertaintyNode(WiredNode):
    """Hands messages to its core, with the time that they lay in the node's queue, and lets time pass."""

    core: UncertaintyCore

    def __init__(self) -> None:
        super().__init__(NODE)
        estimator = GapEstimator(*self.declare_all(UncertaintyCore.parameters))
        self.refuse_unknown_parameters()
        self._continued_clock = ContinuedClock()
        self._sequences: defaultdict[str, MessageSequence] = defaultdict(MessageSequence)
        self.core = UncertaintyCore(estimator, blank, clock=self.now_ns, pace=AdvicePace(TICK))
        self.open_outputs(self.core.outputs)
        # Published before the first image comes, so that a deadline can fire from now on.
        self.publish(self.core.begin(self.now_ns()))
        # Compiled before the first image, so that its estimate is not late.
        warm_up()
        for given in self.core.inputs:
            self.listen(given, partial(self.on_message, given.topic))
        # By the steady clock: silence must be reported when /clock has stopped too.
        self._tick = self.create_timer(TICK, self.on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_tick(self) -> None:
        """Let time pass: estimates that must not wait any longer, and advice that has become ready."""
        self.publish(self.core.ready(self.now_ns()))

    def on_message(self, topic: str, message: Any, info: Mapping[str, int | None]) -> None:
        """Receive a message, and publish the estimates that it made possible."""
        if topic in CONTINUED:
            self.check_sequence(topic, info)
        queued_ns = self.queued_ns(info)
        self.publish(self.core.take(topic, message, self.now_ns(), queued_ns))

    def check_sequence(self, topic: str, info: Mapping[str, int | None]) -> None:
        """End the track if a message does not continue those before, as with two publishers of a topic."""
        number = info.get("publication_sequence_number")
        if not self._sequences[topic].continues(number, time.monotonic()):
            self.core.estimator.break_input(topic)
            words = "two nodes publish it, or its node was started again; stop all but one"
            self.log_once(f"sequence of {topic}", f"the messages of {topic} have a break: {words}")

    def queued_ns(self, info: Mapping[str, int | None]) -> int:
        """How long a message lay in this node's queue: if poses and images lie alike, both are late.

        Zero by a bag's clock, from which it is not known.
        """
        received_ns = info.get("received_timestamp")
        if not received_ns or self.get_clock().ros_time_is_active:
            return 0
        return max(time.time_ns() - received_ns, 0)

    def now_ns(self) -> int:
        """Time by which waiting is measured; with use_sim_time the bag's, so slow replay waits longer.

        It goes on when /clock has stopped: a node that waits for an image or a pose then would wait for ever.
        """
        return self._continued_clock.read(super().now_ns(), time.monotonic_ns())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(UncertaintyNode, argv)
