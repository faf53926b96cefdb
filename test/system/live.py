"""A node of the test's own on a ROS domain of its own, beside the processes that it talks to."""

import time
from collections import defaultdict
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

RELIABLE = QoSProfile(depth=256, reliability=ReliabilityPolicy.RELIABLE)


class Client:
    """Publishes, and collects what comes on the topics it listens to."""

    def __init__(self, domain: int, namespace: str = "/knee_gap") -> None:
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("test_client", namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._outlets: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def listen(self, kind: type, topic: str, **options: Any) -> None:
        """Collect the messages of a topic in `received`."""
        self.node.create_subscription(
            kind, topic, self.received[topic].append, options.pop("qos", RELIABLE), **options
        )

    def publish(self, topic: str, message: Any) -> None:
        """Publish one message."""
        self._outlets[topic].publish(message)

    def offer(self, kind: type, topic: str, qos: QoSProfile = RELIABLE) -> None:
        """Announce a topic to publish on."""
        self._outlets[topic] = self.node.create_publisher(kind, topic, qos)

    def spin(self, seconds: float) -> None:
        """Take what comes for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def spin_until(self, condition: Callable[[], bool], timeout: float = 20.0) -> None:
        """Take what comes until a condition holds; fails after the timeout."""
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, "the condition did not come to hold in time"
            self._executor.spin_once(timeout_sec=0.05)

    def wait_matched(self) -> None:
        """Wait until every topic published here has a subscriber and every topic listened to a publisher."""

        def matched() -> bool:
            heard = all(outlet.get_subscription_count() for outlet in self._outlets.values())
            return heard and all(self.node.count_publishers(self.full(topic)) for topic in self.received)

        self.spin_until(matched)
        # A match is seen on one side before the other.
        self.spin(0.3)

    def full(self, topic: str) -> str:
        """Name of a topic with its namespace."""
        return topic if topic.startswith("/") else f"{self.node.get_namespace()}/{topic}"
