"""Processes a bag into a bag of results: the cores of the live nodes, without ROS and without a clock.

Messages are fed by their header's stamp, none is dropped, and the same bag gives the same bytes.
"""

import heapq
import logging
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.qos import QosName
from knee_gap_core.node.command_line import with_progress

_LOG = logging.getLogger(__name__)

# No driver keeps a message back longer than this [ns]; within it, messages are put in order of their stamps.
MOST_LATENCY_NS = 500_000_000
# Stamps of two topics this far apart are of two clocks [ns]: one since boot, or without a date.
_OTHER_CLOCK_NS = 3_600 * 1_000_000_000
# By so many messages a topic's clock is known, looked for in so long a part of the bag [ns].
_ENOUGH_MESSAGES = 20
_CLOCK_SEARCH_NS = 30 * 1_000_000_000


class Output(NamedTuple):
    """A message that a pipeline publishes, and the stamp that it belongs to [ns]."""

    topic: str
    message: Any
    stamp_ns: int


class Pipeline(Protocol):
    """What turns messages, in the order of their stamps, into results.

    `inputs` are the topics it needs; of messages with the same stamp, those of the first come first.
    `outputs` are the topics it publishes, with their types and quality of service.
    """

    @property
    def inputs(self) -> Sequence[str]:
        """Topics."""

    @property
    def outputs(self) -> Mapping[str, tuple[str, QosName]]:
        """Type and quality of service of each topic."""

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        """Take one message and return what follows from it."""

    def finish(self) -> Iterable[Output]:
        """Return what was still waiting for more."""


class Stamped(NamedTuple):
    """A message in the order of stamps; among equal stamps, by the rank of its topic, then as recorded.

    `stamp_ns` is the header's, by the clock of the other topics where the topic has one of its own.
    """

    stamp_ns: int
    rank: int
    number: int
    message: BagMessage


def by_stamp(reader: BagReader, topics: Sequence[str]) -> Iterator[Stamped]:
    """Yield the messages of `topics` by their stamps.

    Where the stamps of a topic run backwards (a recorded loop), what came before is yielded first. A topic
    whose stamps are of another clock is put where it was recorded, as it came to the live nodes.
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
    """What to add to the stamps of each topic of another clock than the first's [ns]; none for the same."""
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
    # A median: drivers stamp their first message with 0.
    clocks = {topic: statistics.median_low(known) for topic, known in ahead.items() if known}
    reference = next(iter(clocks.values()), 0)
    shifts = {topic: reference - clock for topic, clock in clocks.items()}
    return {topic: shift for topic, shift in shifts.items() if abs(shift) > _OTHER_CLOCK_NS}


def process(reader: BagReader, writer: BagWriter, pipeline: Pipeline) -> dict[str, int]:
    """Run a bag through a pipeline and write what it publishes; return the number of messages by topic.

    A message that cannot be read is told in one line and left out. Raises BagError where the bag lacks
    a topic that the pipeline needs.
    """
    if missing := [topic for topic in pipeline.inputs if topic not in reader.topics]:
        names = ", ".join(sorted(reader.topics)) or "none"
        raise BagError(f"{reader.path} has no topic {', '.join(missing)}; it has {names}")
    for topic, (msgtype, qos) in pipeline.outputs.items():
        writer.add_topic(topic, msgtype, qos)
    for stamped in with_progress(by_stamp(reader, pipeline.inputs), reader.count(pipeline.inputs)):
        try:
            message = reader.deserialize(stamped.message)
        except BagError as error:
            _LOG.warning(str(error))
            continue
        _write(writer, pipeline.feed(stamped.message.topic, message, stamped.stamp_ns))
    _write(writer, pipeline.finish())
    return writer.counts


def _write(writer: BagWriter, outputs: Iterable[Output]) -> None:
    for topic, message, stamp_ns in outputs:
        # Not the time of writing, so that the same bag gives the same bytes.
        writer.write(topic, message, stamp_ns)
