"""The base of every node: parameters, QoS by purpose, diagnostics, and one way to start and to stop."""

import functools
import gc
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from threadpoolctl import threadpool_limits

from knee_gap_core.live.local_topics import LocalPublisher, LocalTopics
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.parameters import as_rows, declare, refuse_unknown, refused_by_ros, require_files
from knee_gap_core.node.seam import Fault, Seam
from knee_gap_core.node.wiring import Health

Parameters = TypeVar("Parameters")

# Images: whatever the camera offers, and never a growing queue of old ones. Eight hold 133 ms at 60 Hz, which
# a two-core machine needs to lose nothing when another process takes its turn.
IMAGE_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
# Trackers publish best effort or reliable; a best-effort subscription receives both. 64 poses: 0.5 s at 120
# Hz.
TRACKER_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=64, reliability=ReliabilityPolicy.BEST_EFFORT)
# What nodes send to each other and to a controller must arrive.
RESULT_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=64, reliability=ReliabilityPolicy.RELIABLE)
# A subscriber that comes late still gets the last one.
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# The events of a subscription that a node may handle.
EVENTS = ("deadline", "incompatible_qos", "liveliness", "message_lost", "incompatible_type", "matched")


class GuardedNode(Node):
    """A node that no message ends: whatever a callback raises is refused, counted and logged at its seam.

    `local`: topics between the nodes of this process, set before they are made.
    """

    local: LocalTopics | None = None

    def __init__(self, name: str) -> None:
        # Before rclpy's own subscriptions and services, which are guarded as well.
        self.seam = Seam(self._on_fault, passes=self._is_shutdown)
        self._faults_logged: set[str] = set()
        super().__init__(name)

    def start(self) -> None:
        """Begin to work; called once all is set up."""

    def recover(self, fault: Fault) -> None:
        """Reset the core after a fault, and answer what it refused; a node that has a core does so."""

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *options: Any, **named: Any
    ) -> Any:
        """Subscribe as rclpy does, with all callbacks guarded."""
        events = named.get("event_callbacks")
        for event in EVENTS:
            if (handler := getattr(events, event, None)) is not None:
                setattr(events, event, self.guarded(f"{event} of {topic}", handler))
        guarded = self.guarded(f"message on {topic}", callback)
        if self.local is not None and (name := self.resolve_topic_name(topic)) in self.local.names:
            return self.local.subscribe(name, guarded)
        return super().create_subscription(msg_type, topic, self.one_at_a_time(guarded), *options, **named)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *options: Any, **named: Any
    ) -> Any:
        """Start a timer as rclpy does, with a guarded callback."""
        what = f"call of {getattr(callback, '__name__', 'a timer')}"
        guarded = self.one_at_a_time(self.guarded(what, callback))
        return super().create_timer(timer_period_sec, guarded, *options, **named)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], *options: Any, **named: Any
    ) -> Any:
        """Offer a service as rclpy does; a request that raises gets the empty answer, with the reason."""

        def answer(fault: Fault, _: Any, response: Any) -> Any:
            self._recover(fault)
            for field in ("reason", "message"):
                if hasattr(response, field):
                    setattr(response, field, fault.reason)
            return response

        guarded = self.one_at_a_time(self.seam.guarded(f"request of {srv_name}", answer, callback))
        return super().create_service(srv_type, srv_name, guarded, *options, **named)

    def create_publisher(self, msg_type: Any, topic: str, *options: Any, **named: Any) -> Any:
        """Publish as rclpy does, and to the nodes of this process directly."""
        publisher = super().create_publisher(msg_type, topic, *options, **named)
        if self.local is None or (name := self.resolve_topic_name(topic)) not in self.local.names:
            return publisher
        return LocalPublisher(publisher, self.local, name)

    def one_at_a_time(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """A callback that waits while another thread calls into a node of this process."""
        if self.local is None:
            return callback
        lock = self.local.lock

        @functools.wraps(callback)
        def alone(*arguments: Any) -> Any:
            with lock:
                return callback(*arguments)

        return alone

    def guarded(self, what: str, callback: Callable[..., None]) -> Callable[..., None]:
        """A callback that raises nothing: what it would raise refuses `what`, and the core is reset."""
        return self.seam.guarded(what, lambda fault, *_: self._recover(fault), callback)

    def _recover(self, fault: Fault) -> None:
        # A reset that fails is counted too, and does not end the node either.
        self.seam.call(f"recovery after {fault.what}", lambda _: None, lambda: self.recover(fault))

    def _on_fault(self, fault: Fault) -> None:
        """Log a fault the first time that it comes; later ones are counted only."""
        if fault.reason not in self._faults_logged:
            self._faults_logged.add(fault.reason)
            self.get_logger().error(fault.line)
            self.get_logger().debug(fault.traceback)

    def _is_shutdown(self, error: Exception) -> bool:
        """Whether an exception ends the node as it should: ROS is shut down, or a signal came meanwhile."""
        return isinstance(error, ExternalShutdownException) or not self.context.ok()


class BaseNode(GuardedNode):
    """A node whose parameters come from a dataclass and that reports its health once a second."""

    def __init__(self, name: str, *, health: Callable[[], Health]) -> None:
        with refused_by_ros():
            super().__init__(name)
        self._health = health
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RESULT_QOS)
        self._diagnostics_timer = self.create_timer(1.0, self.publish_diagnostics)
        self._reasons_logged: set[str] = set()
        self._faults_before = 0
        # Topics that the node cannot do without, with the number of diagnostics since one was last published.
        self._inputs: dict[str, int] = {}

    def declare(self, kind: type[Parameters]) -> Parameters:
        """Declare the fields of the dataclass `kind` as read-only parameters; return their values."""
        return declare(self, kind)

    def refuse_unknown_parameters(self) -> None:
        """Refuse to start with a parameter that no component declared."""
        refuse_unknown(self)

    def publish_diagnostics(self) -> None:
        """Publish the node's health now."""
        well, words, counts = self._health()
        if (faults := self.seam.counts.total()) > self._faults_before:
            well, words = False, f"{faults - self._faults_before} messages refused by a fault; {words}"
        self._faults_before = faults
        if missing := self._unpublished_inputs():
            well, words = False, f"nobody publishes {', '.join(missing)}; {words}"
            self.log_once(f"nobody publishes {missing}", f"nobody publishes {', '.join(missing)}")
        counts = {**counts, **self.seam.counts}
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK if well else DiagnosticStatus.WARN,
            name=self.get_fully_qualified_name(),
            message=words,
            values=[KeyValue(key=key, value=value) for key, value in as_rows(counts)],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def watch_input(self, topic: str) -> None:
        """Report in log and diagnostics if nobody publishes a topic that the node cannot do without."""
        self._inputs[self.resolve_topic_name(topic)] = 0

    def forget_input(self, topic: str) -> None:
        """No longer watch a topic."""
        self._inputs.pop(self.resolve_topic_name(topic), None)

    def _unpublished_inputs(self) -> list[str]:
        """Watched topics that nobody has published for two diagnostics, so two seconds."""
        for topic in self._inputs:
            self._inputs[topic] = 0 if self.count_publishers(topic) else self._inputs[topic] + 1
        return [topic for topic, unpublished in self._inputs.items() if unpublished >= 2]

    def log_once(self, reason: str, words: str) -> None:
        """Log `words` the first time that `reason` comes; later ones are counted in the diagnostics only."""
        if reason not in self._reasons_logged:
            self._reasons_logged.add(reason)
            self.get_logger().warning(words)


def _is_interrupted(error: BaseException | None) -> bool:
    """Whether an exception was caused by a request to stop."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def run(make_node: Callable[[], Any], argv: Sequence[str] | None = None) -> int:
    """Start a node, spin until it is stopped, return the exit code: 2 for a mistake of the user's."""
    return run_all([make_node], argv)


def run_all(make_nodes: Sequence[Callable[[], Any]], argv: Sequence[str] | None = None) -> int:
    """As `run`, with all nodes in one executor."""
    try:
        require_files(sys.argv if argv is None else argv)
        rclpy.init(args=None if argv is None else list(argv))
    except Exception as error:  # rclpy's parser raises several unrelated kinds for a bad --ros-args
        print(f"cannot start: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    # The matrices here are small: threads of the linear algebra would spin for a second core and win nothing.
    threadpool_limits(1)
    executor = None
    nodes: list[Any] = []
    try:
        for make_node in make_nodes:
            nodes.append(make_node())
        # One executor for the whole run: rclpy.spin_once builds and tears one down at every call.
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        # All that stands by now stays. To look through it again for garbage takes longer than an image may.
        gc.collect()
        gc.freeze()
        for node in nodes:
            node.start()
            node.get_logger().info("ready")
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigurationError as error:
        print(f"cannot start: {error}", file=sys.stderr)
        return 2
    except Exception as error:
        # A signal between two looks of the executor ends the context under it, which it takes for an error;
        # one while a kernel is loaded comes out of foreign code as an error of that.
        if rclpy.ok() and not _is_interrupted(error):
            raise
    finally:
        if executor is not None:
            # Before what the middleware would call is gone.
            executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
