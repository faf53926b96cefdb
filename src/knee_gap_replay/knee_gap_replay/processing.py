"""Offline processing of a bag by a pipeline, without ROS and without a clock.

Messages are fed in the order of their header stamps, none is dropped, and the same bag gives the same bytes.
"""

import heapq
import logging
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.qos import QosName
from knee_gap_core.bag.writing.bag_writer import SPAN_NS
from knee_gap_core.node.command_line import with_progress
from knee_gap_core.node.wiring import Output

_LOG = logging.getLogger(__name__)

# Largest latency of a driver [ns]: within it, messages are sorted by their stamps.
MOST_LATENCY_NS = 500_000_000
# Stamps of two topics at least this far apart are of different clocks [ns]: one may count since boot.
_OTHER_CLOCK_NS = 3_600 * 1_000_000_000
# Messages needed to determine a topic's clock, and the length of the part of the bag that is searched [ns].
_ENOUGH_MESSAGES = 20
_CLOCK_SEARCH_NS = 30 * 1_000_000_000


class Pipeline(Protocol):
    """Interface of a processor: messages in the order of their stamps in, results out.

    `inputs` are the topics it needs; among messages of the same stamp, those of earlier topics come first.
    `outputs` are the topics it publishes, with their types and quality of service.
    """

    @property
    def inputs(self) -> Sequence[str]:
        """Topics."""

    @property
    def outputs(self) -> Mapping[str, tuple[str, QosName]]:
        """Type and quality of service of each topic."""

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        """Process one message; return the results."""

    def finish(self) -> Iterable[Output]:
        """Return the results that were still waiting for more input."""


class Stamped(NamedTuple):
    """A message with its sorting key: stamp, then rank of its topic, then position in the bag.

    `stamp_ns` is the header's stamp, converted to the clock of the other topics if its topic has another.
    """

    stamp_ns: int
    rank: int
    number: int
    message: BagMessage


def by_stamp(reader: BagReader, topics: Sequence[str]) -> Iterator[Stamped]:
    """Yield the messages of `topics` in the order of their stamps.

    If the stamps of a topic run backwards (a recorded loop), the messages before that are yielded first. A
    topic whose stamps are of another clock is ordered by its recording times, as it was received live.
    """
    shifts = _shifts(reader, topics)
    rank = {topic: index for index, topic in enumerate(topics)}
    newest: dict[str, int] = {}
    waiting: list[Stamped] = []
    for number, message in enumerate(reader.messages(topics)):
        stamp_ns = reader.stamp_ns(message)
        if stamp_ns is None:
            raise BagError(f"{message.topic} has messages without a stamp ({message.msgtype})")
        if stamp_ns < newest.get(message.topic, stamp_ns) - MOST_LATENCY_NS:
            while waiting:
                yield heapq.heappop(waiting)
            newest.clear()
        newest[message.topic] = max(stamp_ns, newest.get(message.topic, stamp_ns))
        shifted_ns = stamp_ns + shifts.get(message.topic, 0)
        heapq.heappush(waiting, Stamped(shifted_ns, rank[message.topic], number, message))
        while waiting[0].message.time_ns < message.time_ns - MOST_LATENCY_NS:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)


def _shifts(reader: BagReader, topics: Sequence[str]) -> dict[str, int]:
    """Offset to add to the stamps of each topic whose clock differs from the first topic's [ns]."""
    ahead: dict[str, list[int]] = {topic: [] for topic in topics}
    begin_ns: int | None = None
    for message in reader.messages(topics):
        begin_ns = message.time_ns if begin_ns is None else begin_ns
        stamp_ns = reader.stamp_ns(message)
        if stamp_ns is not None:
            ahead[message.topic].append(stamp_ns - message.time_ns)
        enough = all(len(known) >= _ENOUGH_MESSAGES for known in ahead.values())
        if enough or message.time_ns - begin_ns > _CLOCK_SEARCH_NS:
            break
    # The median, since some drivers stamp their first message with 0.
    clocks = {topic: statistics.median_low(known) for topic, known in ahead.items() if known}
    reference = next(iter(clocks.values()), 0)
    shifts = {topic: reference - clock for topic, clock in clocks.items()}
    return {topic: shift for topic, shift in shifts.items() if abs(shift) > _OTHER_CLOCK_NS}


class LogClock:
    """Times at which results are logged: their stamps, on a clock that never runs backwards.

    If the stamps of the input run backwards (a recorded loop), the clock runs on where it was. A result with
    a stamp of another clock is logged at the present time.
    """

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._shift_ns = self._now_ns = 0

    def advance(self, stamp_ns: int) -> None:
        """Note the stamp of a message that is fed."""
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns - MOST_LATENCY_NS:
            self._shift_ns += self._stamp_ns - stamp_ns
        self._stamp_ns = stamp_ns
        self._now_ns = max(self._now_ns, stamp_ns + self._shift_ns)

    def log_ns(self, stamp_ns: int) -> int:
        """Return the log time [ns] of a result with a stamp."""
        time_ns = stamp_ns + self._shift_ns
        return time_ns if self._now_ns - SPAN_NS <= time_ns <= self._now_ns else self._now_ns


class Fed(NamedTuple):
    """A message to feed into a pipeline; `message` is None where it cannot be read."""

    topic: str
    message: Any
    stamp_ns: int


def fed(reader: BagReader, topics: Sequence[str]) -> Iterator[Fed]:
    """Yield the messages of `topics` in the order of their stamps; log what cannot be read."""
    for stamped in by_stamp(reader, topics):
        message = None
        try:
            message = reader.deserialize(stamped.message)
        except BagError as error:
            _LOG.warning(str(error))
        yield Fed(stamped.message.topic, message, stamped.stamp_ns)


def announce(reader: BagReader, writer: BagWriter, pipeline: Pipeline) -> None:
    """Announce the results. Raises BagError if the bag lacks a topic that the pipeline needs."""
    if missing := [topic for topic in pipeline.inputs if topic not in reader.topics]:
        names = ", ".join(sorted(reader.topics)) or "none"
        raise BagError(f"{reader.path} has no topic {', '.join(missing)}; it has {names}")
    for topic, (msgtype, qos) in pipeline.outputs.items():
        writer.add_topic(topic, msgtype, qos)


def process(reader: BagReader, writer: BagWriter, pipeline: Pipeline) -> dict[str, int]:
    """Process a bag with a pipeline and write the results; return the number of messages by topic.

    A message that cannot be read is reported in one line and skipped. Raises BagError if the bag lacks a
    topic that the pipeline needs.
    """
    announce(reader, writer, pipeline)
    clock = LogClock()
    messages = fed(reader, pipeline.inputs)
    for topic, message, stamp_ns in with_progress(messages, reader.count(pipeline.inputs), stamp_of):
        clock.advance(stamp_ns)
        if message is not None:
            _write(writer, clock, pipeline.feed(topic, message, stamp_ns))
    _write(writer, clock, pipeline.finish())
    return writer.counts


def stamp_of(item: Fed) -> int:
    """Return the stamp [ns] by which progress is measured."""
    return item.stamp_ns


def _write(writer: BagWriter, clock: LogClock, outputs: Iterable[Output]) -> None:
    for topic, message, stamp_ns in outputs:
        # Not the present time, so that the same bag gives the same bytes.
        writer.write(topic, message, clock.log_ns(stamp_ns))
