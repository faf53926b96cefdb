"""The command `record`: ROS topics written to a bag, byte for byte."""

import argparse
import logging
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial

import rclpy
from rclpy.clock import ROSClock
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import remove_ros_args
from rclpy.validate_topic_name import validate_topic_name
from rosbags.interfaces import Qos, QosDurability, QosReliability

from knee_gap_core.bag.bag import BagMessage, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import known_type, message_class
from knee_gap_core.bag.qos import PROFILES
from knee_gap_core.bag.writing.bag_writer import Split
from knee_gap_core.bag.writing.mcap_storage import COMPRESSIONS
from knee_gap_core.live.base_node import GuardedNode
from knee_gap_core.node.command_line import Parser, positive, run, stop_on_signals
from knee_gap_core.node.parameters import refuse_unknown, refused_by_ros, require_files
from knee_gap_replay.recording import WriterThread
from knee_gap_replay.whole_bags.output import add_force_argument

_LOG = logging.getLogger(__name__)
# One second of a tracker at 240 Hz, four of images: how long the recorder may be stalled on a busy machine.
_DEPTH = 256
_LOOK_SECONDS = 0.02
# How far messages of two topics may arrive out of the order of their times [ns].
_SPAN_NS = 200_000_000
_LEAST_FILE_BYTES = 1_000_000


class RecordNode(GuardedNode):
    """Subscribes to each topic once it is published, with the quality of service of its weakest publisher."""

    def __init__(self, topics: Sequence[str], writer: WriterThread, *, every: bool = False) -> None:
        with refused_by_ros():
            super().__init__("record")
        refuse_unknown(self)
        self._writer = writer
        self._wanted = [self._resolved(topic) for topic in dict.fromkeys(topics)]
        self._asked_for = tuple(self._wanted)
        self._every = every
        self._refused: set[str] = set()
        # Added to times of receipt, so that they run on where the clock is set back (a loop of a bag).
        self._shift_ns = self._newest_ns = 0
        self._subscriptions_by_topic: dict[str, Subscription] = {}
        self._profiles: dict[str, QoSProfile] = {}
        self._last_numbers: dict[str, int] = {}
        self.lost: Counter[str] = Counter()
        self.create_timer(_LOOK_SECONDS, self.look_for_publishers)
        self.look_for_publishers()

    @property
    def silent_topics(self) -> list[str]:
        """Topics that were asked for and without a message so far."""
        return [topic for topic in self._asked_for if topic not in self._last_numbers]

    def look_for_publishers(self) -> None:
        """Subscribe to new topics; subscribe again if a new publisher offers a weaker quality of service."""
        if self._every:
            wanted = set(self._wanted)
            names = sorted(name for name, _ in self.get_topic_names_and_types() if "/_" not in name)
            self._wanted += [name for name in names if name not in wanted]
        for topic in self._wanted:
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers or topic in self._refused:
                continue
            profile = _weakest(publishers)
            if (known := self._profiles.get(topic)) is not None:
                if known == profile or known.reliability == ReliabilityPolicy.BEST_EFFORT:
                    continue
                _LOG.warning("%s has a publisher of weaker quality of service; subscribing again", topic)
                self.destroy_subscription(self._subscriptions_by_topic[topic])
            try:
                self._subscribe(topic, publishers, profile)
            except BagError as error:
                self._refused.add(topic)
                _LOG.warning("%s is not recorded: %s", topic, error)

    def _resolved(self, topic: str) -> str:
        try:
            validate_topic_name(topic)
        except InvalidTopicNameException:
            raise BagError(f"'{topic}' is not a topic name") from None
        return str(self.resolve_topic_name(topic))

    def _subscribe(self, topic: str, publishers: Sequence[TopicEndpointInfo], profile: QoSProfile) -> None:
        msgtype = known_type(publishers[0].topic_type)
        kind = message_class(msgtype)
        self._writer.add_topic(topic, msgtype, [_offered(publisher) for publisher in publishers])
        self._profiles[topic] = profile
        self._subscriptions_by_topic[topic] = self.create_subscription(
            kind, topic, partial(self._keep, topic, msgtype), profile, raw=True
        )
        print(f"record: {topic} ({msgtype})", flush=True)

    def _keep(self, topic: str, msgtype: str, data: bytes, info: Mapping[str, int | None]) -> None:
        self._count_lost(topic, info.get("publication_sequence_number"))
        received = info.get("received_timestamp")
        clock = self.get_clock()
        now_ns = clock.now().nanoseconds
        if received is None or (isinstance(clock, ROSClock) and clock.ros_time_is_active):
            received = now_ns
        self._shift_ns += max(0, self._newest_ns - now_ns)
        self._newest_ns = now_ns
        self._writer.put(BagMessage(topic, msgtype, received + self._shift_ns, data))

    def _count_lost(self, topic: str, number: int | None) -> None:
        """Count missing sequence numbers of a topic's only publisher; each publisher has its own sequence."""
        if number is None:
            return
        last = self._last_numbers.get(topic)
        if last is not None and number > last + 1 and self.count_publishers(topic) == 1:
            self.lost[topic] += number - last - 1
        self._last_numbers[topic] = number


def _weakest(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the strongest quality of service that every publisher satisfies."""
    reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _offered(publisher: TopicEndpointInfo) -> Qos:
    """Return a publisher's quality of service for the bag; DDS does not report the depth of its history."""
    profile = publisher.qos_profile
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    return PROFILES["latched" if latched else "reliable"]._replace(
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
    )


def _run(arguments: argparse.Namespace) -> int:
    if not arguments.topics and not arguments.all:
        raise BagError("the following arguments are required: TOPIC, or --all")
    stop = stop_on_signals()
    duration = arguments.max_bag_duration
    split = Split(arguments.max_bag_size, None if duration is None else round(duration * 1e9))
    bag = BagWriter(
        arguments.out,
        compression=arguments.compression,
        split=split,
        span_ns=_SPAN_NS,
        replace=arguments.force,
    )
    writer = WriterThread(bag)
    node = RecordNode(arguments.topics, writer, every=arguments.all)
    try:
        with bag:
            writer.start()
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            end = time.monotonic() + (arguments.duration or float("inf"))
            try:
                while not stop.is_set() and time.monotonic() < end and writer.error is None:
                    executor.spin_once(timeout_sec=0.05)
            finally:
                writer.finish()
                node.destroy_node()
    except BagError as error:
        received = bag.counts.total()
        raise BagError(f"{error}; of {received} messages those before it are kept and readable") from None
    return _report(node, writer, bag, arguments.out)


def _report(node: RecordNode, writer: WriterThread, bag: BagWriter, out: str) -> int:
    if writer.error is not None:
        raise BagError(f"{out}: {writer.error}")
    counts = bag.counts
    for topic in node.silent_topics:
        _LOG.warning("no message was received on %s", topic)
    lost = node.lost + writer.dropped
    for topic, count in sorted(lost.items()):
        _LOG.warning("%d messages of %s were lost", count, topic)
    for fault, count in node.seam.counts.items():
        _LOG.warning("%d: %s", count, fault)
    print(f"record: {sum(counts.values())} messages of {len(counts)} topics in {out}", flush=True)
    return 1 if lost or node.seam.counts else 0


def _size(text: str) -> int:
    if not text.isdecimal() or int(text) < _LEAST_FILE_BYTES:
        raise argparse.ArgumentTypeError(f"must be at least {_LEAST_FILE_BYTES} bytes, not '{text}'")
    return int(text)


def _parser() -> Parser:
    parser = Parser(prog="record", description=__doc__)
    parser.add_argument("out", metavar="OUT", help="the bag to write")
    add_force_argument(parser)
    parser.add_argument(
        "topics",
        nargs="*",
        metavar="TOPIC",
        help="topics to record, once they are published",
    )
    parser.add_argument("--all", action="store_true", help="record every topic, as it appears")
    parser.add_argument(
        "--compression", choices=tuple(COMPRESSIONS), default="none", help="of the chunks (none)"
    )
    parser.add_argument(
        "--max-bag-size", type=_size, metavar="BYTES", help="begin a new file before one grows larger"
    )
    parser.add_argument(
        "--max-bag-duration", type=positive, metavar="SECONDS", help="begin a new file after this time"
    )
    parser.add_argument("--duration", type=positive, metavar="SECONDS", help="stop after this time")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Record topics until SIGINT or SIGTERM; takes ROS arguments (--ros-args) like any node."""
    given = list(sys.argv[1:] if argv is None else argv)
    try:
        require_files(given)
        rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's parser raises several unrelated kinds for a bad --ros-args
        print(f"record: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    try:
        return run(_parser(), _run, remove_ros_args(["record", *given])[1:])
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
