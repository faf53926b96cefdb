"""The command `play`: a bag published on ROS topics, byte for byte."""

import argparse
import logging
import sys
import threading
import time
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence

import rclpy
from rclpy.clock import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from rclpy.utilities import remove_ros_args
from rosbags.interfaces import QosReliability
from rosgraph_msgs.msg import Clock

from knee_gap_core.bag import qos as qos_profiles
from knee_gap_core.bag.bag import BagMessage, BagReader, Topic
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import check_type_hash, message_class
from knee_gap_core.live.base_node import GuardedNode
from knee_gap_core.node.command_line import (
    Parser,
    not_negative,
    positive,
    run,
    stop_on_signals,
    with_progress,
)
from knee_gap_core.node.keyboard import keys
from knee_gap_core.node.parameters import refuse_unknown, refused_by_ros, require_files
from knee_gap_replay.playback import (
    Controls,
    Event,
    Pace,
    Played,
    play_once,
    read_ahead,
    window,
    with_clock,
    without_clock,
)

_LOG = logging.getLogger(__name__)
# Two seconds of a tracker, four of images: how far a reliable subscriber may fall behind without loss. The
# memory is used only while a subscriber is behind.
_DEPTH = 256
_SETTLE_SECONDS = 0.2
_ACKNOWLEDGE_SECONDS = 2.0


class PlayNode(GuardedNode):
    """Publishers for the topics of a bag. Topics of unknown types are skipped with one line each."""

    def __init__(
        self,
        reader: BagReader,
        topics: Collection[str],
        *,
        clock: bool,
        remap: Mapping[str, str] | None = None,
        recorded_qos: bool = False,
    ) -> None:
        with refused_by_ros():
            super().__init__("play")
        refuse_unknown(self)
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._remap = dict(remap or {})
        self._recorded_qos = recorded_qos
        for name in sorted(topics):
            try:
                self._publishers_by_topic[name] = self._publisher(name, reader.details[name])
            except BagError as error:
                _LOG.warning("%s is not played: %s", name, error)
        if not self._publishers_by_topic:
            raise BagError(f"{reader.path} has no topic that can be played")
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10) if clock else None

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that are played."""
        return tuple(self._publishers_by_topic)

    def emit(self, event: Event) -> None:
        """Publish a message unchanged, or the bag's time."""
        if event.message is not None:
            self._publishers_by_topic[event.message.topic].publish(event.message.data)
        elif self._clock_publisher is not None:
            now = Time(nanoseconds=event.time_ns, clock_type=ClockType.ROS_TIME)
            self._clock_publisher.publish(Clock(clock=now.to_msg()))

    def wait_for_subscribers(self, topics: Collection[str], seconds: float, stop: threading.Event) -> None:
        """Return once each of `topics` has a subscriber. Raises BagError if one has none in time."""
        deadline = time.monotonic() + seconds
        while waiting := [t for t in topics if not self._publishers_by_topic[t].get_subscription_count()]:
            if time.monotonic() > deadline:
                raise BagError(f"no subscriber to {', '.join(waiting)} within {seconds:g} s")
            if stop.wait(0.02):
                return
        # The publisher discovers a match first; the subscriber needs a moment to discover it too.
        stop.wait(_SETTLE_SECONDS)

    def flush(self) -> None:
        """Return when all subscribers have acknowledged the messages, or after a timeout."""
        for publisher in self._publishers_by_topic.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_SECONDS))
        time.sleep(_SETTLE_SECONDS)

    def _publisher(self, name: str, topic: Topic) -> Publisher:
        if topic.encoding != "cdr":
            raise BagError(f"it is serialised as '{topic.encoding}', not cdr")
        check_type_hash(topic.msgtype, topic.type_hash)
        try:
            qos = _recorded(topic) if self._recorded_qos else _offered(topic)
            return self.create_publisher(message_class(topic.msgtype), self._remap.get(name, name), qos)
        except InvalidTopicNameException as error:
            raise BagError(str(error).partition("\n")[0]) from None


def _offered(topic: Topic) -> QoSProfile:
    """Return the quality of service of a replay: always reliable, which suits best-effort subscribers too."""
    latched = qos_profiles.is_latched(topic.qos)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _recorded(topic: Topic) -> QoSProfile:
    """Return the quality of service recorded in the bag; that of `_offered` if there is none."""
    if not topic.qos:
        return _offered(topic)
    reliable = all(qos.reliability == QosReliability.RELIABLE for qos in topic.qos)
    latched = qos_profiles.is_latched(topic.qos)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(1, *(qos.depth for qos in topic.qos)),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _messages(node: PlayNode, reader: BagReader, arguments: argparse.Namespace) -> Iterator[BagMessage]:
    """Return the messages of the part of the bag that is to be played."""
    if not arguments.start_offset and arguments.playback_duration is None:
        return reader.messages(node.topics)
    begin_ns = reader.start_ns + round(arguments.start_offset * 1e9)
    end_ns = None
    if arguments.playback_duration is not None:
        end_ns = begin_ns + round(arguments.playback_duration * 1e9)
    latched = [name for name in node.topics if qos_profiles.is_latched(reader.details[name].qos)]
    messages = reader.messages(node.topics, begin_ns=begin_ns, before=latched)
    return window(messages, begin_ns, end_ns, latched)


def _play(
    node: PlayNode,
    reader: BagReader,
    arguments: argparse.Namespace,
    stop: threading.Event,
    controls: Controls,
) -> Played:
    """Play once, or in a loop until stopped."""
    begin_ns = time.monotonic_ns()
    late_ns = array("q")
    is_part = arguments.start_offset or arguments.playback_duration is not None
    total = None if is_part else reader.count(node.topics)
    while True:
        ahead = read_ahead(_messages(node, reader, arguments), stop)
        messages = with_progress(ahead, total, lambda message: message.time_ns)
        events = with_clock(messages) if arguments.clock else without_clock(messages)
        pace = Pace(begin_ns, arguments.rate)
        played = play_once(events, pace, node.emit, time.monotonic_ns, stop.wait, controls)
        late_ns += played.late_ns
        if stop.is_set() or not arguments.loop or not played.message_count:
            return Played(len(late_ns), max(late_ns, default=0), played.end_ns, late_ns)
        begin_ns = played.end_ns


def _remapped(pairs: Sequence[str], topics: Collection[str]) -> dict[str, str]:
    """Return the new names of topics from FROM:=TO. Raises BagError."""
    remap: dict[str, str] = {}
    for pair in pairs:
        name, sign, new = pair.partition(":=")
        if not sign or not name or not new:
            raise BagError(f"--remap takes FROM:=TO, not '{pair}'")
        if name not in topics:
            raise BagError(f"--remap {pair}: the bag has no topic {name}; it has {', '.join(sorted(topics))}")
        remap[name] = new
    return remap


def _run(arguments: argparse.Namespace) -> int:
    with BagReader(arguments.bag) as reader:
        if reader.renamed:
            print(f"play: {reader.renamed}", flush=True)
        chosen = frozenset(arguments.topics or reader.topics)
        reader.messages([*chosen, *arguments.wait_for])  # raises for a topic that is not in the bag
        stop = stop_on_signals()
        remap = _remapped(arguments.remap, reader.topics)
        recorded = arguments.qos == "recorded"
        node = PlayNode(reader, chosen, clock=arguments.clock, remap=remap, recorded_qos=recorded)
        controls = Controls(paused=arguments.start_paused)
        try:
            if unplayed := sorted(set(arguments.wait_for) - set(node.topics)):
                raise BagError(f"--wait-for {', '.join(unplayed)}: not played")
            node.wait_for_subscribers(arguments.wait_for, arguments.wait_timeout, stop)
            begin = time.monotonic()
            with keys(controls.press) as listening:
                if listening:
                    print("play: space pauses, n plays one message, up and down change the rate", flush=True)
                if not stop.wait(arguments.delay):
                    played = _play(node, reader, arguments, stop, controls)
                    seconds = time.monotonic() - begin - arguments.delay
                    print(
                        f"play: {played.message_count} messages of {len(node.topics)} topics in "
                        f"{seconds:.1f} s, {played.late_words()}",
                        flush=True,
                    )
                    node.flush()
        finally:
            node.destroy_node()
    return 0


def _parser() -> Parser:
    parser = Parser(prog="play", description=__doc__)
    parser.add_argument("bag", metavar="BAG", help="bag folder or .mcap file")
    parser.add_argument("--rate", type=positive, default=1.0, metavar="R", help="times as fast as recorded")
    parser.add_argument(
        "--loop", action="store_true", help="start again at the end; header stamps then jump back"
    )
    parser.add_argument("--clock", action="store_true", help="publish the bag's time on /clock, at 100 Hz")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play only these topics")
    parser.add_argument(
        "--start-offset",
        type=not_negative,
        default=0.0,
        metavar="SECONDS",
        help="start at this time after the beginning of the bag",
    )
    parser.add_argument(
        "--playback-duration", type=positive, metavar="SECONDS", help="play only this duration"
    )
    parser.add_argument(
        "--start-paused", action="store_true", help="begin paused; needs a terminal for the keys"
    )
    parser.add_argument(
        "--remap", nargs="+", default=[], metavar="FROM:=TO", help="publish topics under other names"
    )
    parser.add_argument(
        "--qos",
        choices=("reliable", "recorded"),
        default="reliable",
        help="offer reliable topics, which suit every subscriber, or as recorded; latched topics are "
        "always those of the bag",
    )
    parser.add_argument(
        "--delay", type=not_negative, default=0.0, metavar="SECONDS", help="wait before the first message"
    )
    parser.add_argument(
        "--wait-for", nargs="+", default=[], metavar="TOPIC", help="start when each of these has a subscriber"
    )
    parser.add_argument(
        "--wait-timeout", type=positive, default=30.0, metavar="SECONDS", help="how long --wait-for waits"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Play a bag; takes ROS arguments (--ros-args) like any node."""
    given = list(sys.argv[1:] if argv is None else argv)
    # FROM:=TO of --remap is not for rclpy, which would take it for a rule of its own.
    begin = given.index("--ros-args") if "--ros-args" in given else len(given)
    own, ros = given[:begin], given[begin:]
    try:
        require_files(ros)
        rclpy.init(args=ros, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own exceptions for wrong ROS arguments are not public
        print(f"play: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    try:
        return run(_parser(), _run, [*own, *remove_ros_args(["play", *ros])[1:]])
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
