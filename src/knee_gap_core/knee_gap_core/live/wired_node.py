"""The base of a node over a core: it subscribes to, publishes and logs what the core declares and returns."""

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import QoSProfile

from knee_gap_core.bag.message_types import message_class
from knee_gap_core.live.base_node import IMAGE_QOS, LATCHED_QOS, RESULT_QOS, TRACKER_QOS
from knee_gap_core.live.managed_node import ManagedNode
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Health, InputTopic, NodeCore, Notice, Outcome, OutputTopic, Qos

# The middleware reports to a subscriber that asks for this deadline or a longer one that the node is dead.
DEADLINE = Duration(nanoseconds=100_000_000)
# Of each of so many nodes the last message is kept.
MOST_LATCHING = 8
# Compressed images that may wait, a quarter of a second: estimates that are half a second late are refused.
MOST_COMPRESSED = 16
PROFILES = {
    Qos.IMAGE: IMAGE_QOS,
    Qos.COMPRESSED_IMAGE: QoSProfile(depth=MOST_COMPRESSED, reliability=IMAGE_QOS.reliability),
    Qos.TRACKER: TRACKER_QOS,
    Qos.RESULT: RESULT_QOS,
    Qos.DEADLINE: QoSProfile(depth=RESULT_QOS.depth, reliability=RESULT_QOS.reliability, deadline=DEADLINE),
    Qos.LATCHED: LATCHED_QOS,
    Qos.LATCHED_BY_SEVERAL: QoSProfile(
        depth=MOST_LATCHING, reliability=LATCHED_QOS.reliability, durability=LATCHED_QOS.durability
    ),
}

# The executor asks each handler of events at each message; rclpy makes two for a publisher or subscription.
NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)

_class = cache(message_class)


def blank(msgtype: str) -> Any:
    """A default-constructed message of ROS. Raises BagError if its package is not installed."""
    return _class(msgtype)()


class WiredNode(ManagedNode):
    """A node over its `core`, which it makes from its parameters before it opens and listens."""

    core: NodeCore

    def __init__(self, name: str) -> None:
        super().__init__(name, health=self.health)
        self._outlets: dict[str, Any] = {}

    def declare_all(self, kinds: Iterable[type]) -> list[Any]:
        """Declare the fields of dataclasses as read-only parameters; return one instance of each."""
        return [self.declare(kind) for kind in kinds]

    def open_outputs(self, topics: Iterable[OutputTopic]) -> None:
        """Make publishers."""
        for topic, msgtype, qos, _ in topics:
            self._outlets[topic] = self.create_publisher(
                _class(msgtype), topic, PROFILES[qos], event_callbacks=NO_PUBLISHER_EVENTS
            )

    def listen(self, given: InputTopic, callback: Callable[..., None]) -> Any:
        """Subscribe to a topic; report it in log and diagnostics if it is needed and not published."""
        # Between nodes of the suite QoS agrees; a driver's may not, which is then logged.
        events = None if given.from_driver else NO_SUBSCRIPTION_EVENTS
        subscription = self.create_subscription(
            _class(given.msgtype), given.topic, callback, PROFILES[given.qos], event_callbacks=events
        )
        if given.needed:
            self.watch_input(given.topic)
        return subscription

    def publish(self, outcomes: Iterable[Outcome]) -> None:
        """Publish and log what a core returns, one after the other as it comes."""
        for one in outcomes:
            if not isinstance(one, Notice):
                self._outlets[one.topic].publish(one.message)
            elif one.is_error:
                self.get_logger().error(one.words)
            else:
                self.log_once(one.reason, one.words)

    def has_subscribers(self, output: OutputTopic) -> bool:
        """Whether anybody listens to an output."""
        return bool(self._outlets[output.topic].get_subscription_count())

    def recover(self, fault: Fault) -> None:
        """Reset the core, and publish what it answers for the message that raised."""
        self.publish(self.core.recover(fault))

    def now_ns(self) -> int:
        """Clock for waiting times; with use_sim_time the bag's, so that a slow replay waits longer."""
        return int(self.get_clock().now().nanoseconds)

    def health(self) -> Health:
        """Health of the core."""
        return self.core.health()
