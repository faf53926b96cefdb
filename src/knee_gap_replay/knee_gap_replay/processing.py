"""Processes a bag into a bag of results: the cores of the live nodes, without ROS and without a clock.

Messages are fed by their header's stamp, none is dropped, and the same bag gives the same bytes.
"""

import heapq
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from knee_gap_replay.bag import BagMessage, BagReader, BagWriter
from knee_gap_replay.command_line import with_progress
from knee_gap_replay.errors import BagError
from knee_gap_replay.qos import QosName

_LOG = logging.getLogger(__name__)

# No driver keeps a message back longer than this [ns]; within it, messages are put in order of their stamps.
MOST_LATENCY_NS = 500_000_000


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
    """A message in the order of stamps; among equal stamps, by the rank of its topic, then as recorded."""

    stamp_ns: int
    rank: int
    number: int
    message: BagMessage


def by_stamp(reader: BagReader, topics: Sequence[str]) -> Iterator[Stamped]:
    """Yield the messages of `topics` by their stamps.

    Where the stamps of a topic run backwards (a recorded loop), what came before is yielded first.
    """
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
        heapq.heappush(waiting, Stamped(stamp_ns, rank[message.topic], number, message))
        while waiting[0].message.time_ns < message.time_ns - MOST_LATENCY_NS:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)


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
