"""The base of every node: parameters, QoS by purpose, diagnostics, and one way to start and to stop."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from threadpoolctl import threadpool_limits

from knee_gap_node.errors import ConfigurationError
from knee_gap_node.parameters import as_rows, declare, refuse_unknown, refused_by_ros, require_files

Parameters = TypeVar("Parameters")

# Images: whatever the camera offers, and never a growing queue of old ones. Eight hold 133 ms at 60 Hz, which
# a two-core machine needs to lose nothing when another process takes its turn.
IMAGE_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
# Trackers publish best effort or reliable; a best-effort subscription hears both. 64 poses: 0.5 s at 120 Hz.
TRACKER_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=64, reliability=ReliabilityPolicy.BEST_EFFORT)
# What the suite says to itself and to a controller must arrive.
RESULT_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=64, reliability=ReliabilityPolicy.RELIABLE)
# A subscriber that comes late still gets the last one.
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# What a node says of itself once a second: is all well, in a few words, and the counts behind it.
Health = tuple[bool, str, Mapping[str, object]]


class BaseNode(Node):
    """A node whose parameters come from a dataclass and that says once a second how it fares."""

    def __init__(self, name: str, *, health: Callable[[], Health]) -> None:
        with refused_by_ros():
            super().__init__(name)
        self._health = health
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RESULT_QOS)
        self._diagnostics_timer = self.create_timer(1.0, self.publish_diagnostics)
        self._reasons_logged: set[str] = set()

    def declare(self, kind: type[Parameters]) -> Parameters:
        """Declare the fields of the dataclass `kind` as read-only parameters; return their values."""
        return declare(self, kind)

    def refuse_unknown_parameters(self) -> None:
        """Refuse to start with a parameter that no component declared."""
        refuse_unknown(self, self._parameter_overrides)

    def publish_diagnostics(self) -> None:
        """Publish the node's health now."""
        well, words, counts = self._health()
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK if well else DiagnosticStatus.WARN,
            name=self.get_fully_qualified_name(),
            message=words,
            values=[KeyValue(key=key, value=value) for key, value in as_rows(counts)],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def log_once(self, reason: str, words: str) -> None:
        """Log `words` the first time that `reason` comes; later ones are counted in the diagnostics only."""
        if reason not in self._reasons_logged:
            self._reasons_logged.add(reason)
            self.get_logger().warning(words)


def run(make_node: Callable[[], Any], argv: Sequence[str] | None = None) -> int:
    """Start a node, spin until it is told to stop, return the exit code: 2 for a mistake of the user's."""
    try:
        require_files(sys.argv if argv is None else argv)
        rclpy.init(args=None if argv is None else list(argv))
    except Exception as error:  # rclpy's parser raises several unrelated kinds for a bad --ros-args
        print(f"cannot start: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    # The matrices here are small: threads of the linear algebra would spin for a second core and win nothing.
    threadpool_limits(1)
    node = None
    try:
        node = make_node()
        # One executor for the whole run: rclpy.spin_once builds and tears one down at every call.
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.get_logger().info("ready")
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigurationError as error:
        print(f"cannot start: {error}", file=sys.stderr)
        return 2
    except Exception:
        # A signal between two looks of the executor ends the context under it, which it takes for an error.
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
