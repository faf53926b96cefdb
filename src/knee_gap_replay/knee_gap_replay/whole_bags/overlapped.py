"""The two stages of a pipeline side by side: reading and segmentation in a process of their own.

Images are decoded a few ahead in a thread. What passes between the processes are the messages that the
nodes exchange, in the order in which one process would handle them, so that the results have the same bytes.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import typestore
from knee_gap_core.bag.writing.bag_writer import serialized
from knee_gap_core.node.command_line import with_progress
from knee_gap_core.node.wiring import Output
from knee_gap_perception.edge_tracking.edge_stream import ReadAhead, read_image
from knee_gap_replay.pipeline import GapPipeline, Request
from knee_gap_replay.processing import Fed, LogClock, announce, fed

_LOG = logging.getLogger(__name__)
_FORK = multiprocessing.get_context("fork")
# Images that are decoded ahead, and fed messages that are sent together.
_AHEAD = 8
_BATCH = 16


class _Step(NamedTuple):
    """What the first stage gives for one fed message: results and requests, serialised; None at the end."""

    stamp_ns: int | None
    items: list[tuple[Any, ...]]


class _End(NamedTuple):
    """How the first stage ended: why it failed, its flaws, and why no image could be read."""

    error: str
    flaws: list[str]
    unread: str


def process_overlapped(reader: BagReader, writer: BagWriter, pipeline: GapPipeline) -> tuple[list[str], str]:
    """Process a bag as `processing.process` does; return the flaws, and why no image could be read."""
    announce(reader, writer, pipeline)
    ours, theirs = _FORK.Pipe(duplex=False)
    worker = _FORK.Process(target=_first_stage, args=(reader, pipeline, ours, theirs), daemon=True)
    worker.start()
    theirs.close()
    end: list[_End] = []
    clock = LogClock()
    try:
        steps = with_progress(_received(ours, end), reader.count(pipeline.inputs), _stamp_of)
        for stamp_ns, items in steps:
            if stamp_ns is not None:
                clock.advance(stamp_ns)
            for item in items:
                _second_stage(item, writer, pipeline, clock)
    finally:
        ours.close()
        if not end:
            worker.terminate()
        worker.join()
    if not end:
        raise BagError(f"the process that reads and segments ended with {worker.exitcode}")
    if end[0].error:
        raise BagError(end[0].error)
    return [*pipeline.estimation_flaws(), *end[0].flaws], end[0].unread


def _second_stage(item: tuple[Any, ...], writer: BagWriter, pipeline: GapPipeline, clock: LogClock) -> None:
    if len(item) == len(Output._fields):
        topic, data, stamp_ns = item
        writer.write_raw(topic, data, clock.log_ns(stamp_ns))
        return
    request = Request(*item)
    if request.topic:
        msgtype = pipeline.estimated_types[request.topic]
        request = request._replace(message=typestore().deserialize_cdr(request.message, msgtype))
    for topic, answer, stamp_ns in pipeline.estimate(request):
        writer.write(topic, answer, clock.log_ns(stamp_ns))


def _received(connection: Connection, end: list[_End]) -> Iterator[_Step]:
    """Yield the steps of the first stage until it ends; `end` then holds how."""
    while True:
        try:
            batch = connection.recv()
        except EOFError:
            return
        if isinstance(batch, _End):
            end.append(batch)
            return
        yield from batch


def _stamp_of(step: _Step) -> int:
    return 0 if step.stamp_ns is None else step.stamp_ns


def _first_stage(reader: BagReader, pipeline: GapPipeline, theirs: Connection, ours: Connection) -> None:
    """Run in a process of its own; the reader may end at any time, and this process with it."""
    # Ctrl-C goes to both processes; the one that writes ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    theirs.close()
    with contextlib.suppress(BrokenPipeError):
        error = ""
        try:
            for batch in _batches(_steps(reader, pipeline)):
                ours.send(batch)
        except BrokenPipeError:
            raise
        except (BagError, OSError) as failure:
            error = str(failure)
        ours.send(_End(error, pipeline.observation_flaws(), pipeline.unread()))


def _batches(steps: Iterable[_Step]) -> Iterator[list[_Step]]:
    batch: list[_Step] = []
    for step in steps:
        batch.append(step)
        if len(batch) == _BATCH:
            yield batch
            batch = []
    yield batch


def _steps(reader: BagReader, pipeline: GapPipeline) -> Iterator[_Step]:
    packer = _Packer(pipeline)
    # The file's place is shared with the process that forked; read it through a handle of our own.
    with BagReader(reader.path) as own:
        for topic, message, stamp_ns in _decoded_ahead(fed(own, pipeline.inputs), pipeline.inputs[-1]):
            if message is None:
                yield _Step(stamp_ns, [])
                continue
            observed = pipeline.observe(topic, message, stamp_ns)
            yield _Step(stamp_ns, [packer.packed(item) for item in observed])
    yield _Step(None, [packer.packed(item) for item in pipeline.observe_end()])


class _Packer:
    """Serialises results and requests; a message that is both is serialised once."""

    def __init__(self, pipeline: GapPipeline) -> None:
        self._pipeline = pipeline
        self._last: Any = None
        self._data = b""

    def packed(self, item: Output | Request) -> tuple[Any, ...]:
        """Return what `_second_stage` takes."""
        if isinstance(item, Output):
            data = self._serialized(item.message, self._pipeline.outputs[item.topic][0])
            return (item.topic, data, item.stamp_ns)
        if item.topic:
            msgtype = self._pipeline.estimated_types[item.topic]
            item = item._replace(message=self._serialized(item.message, msgtype))
        return tuple(item)

    def _serialized(self, message: Any, msgtype: str) -> bytes:
        if message is not self._last:
            self._last, self._data = message, serialized(message, msgtype)
        return self._data


def _decoded_ahead(messages: Iterable[Fed], image_topic: str) -> Iterator[Fed]:
    """Yield the messages, with pictures that are decoded in a thread."""
    waiting: deque[Fed] = deque()
    images = 0
    with ThreadPoolExecutor(max_workers=1) as pool:
        for item in messages:
            if item.topic == image_topic and item.message is not None:
                future = pool.submit(read_image, item.message)
                item = item._replace(message=ReadAhead(item.message.header, future.result))
                images += 1
            waiting.append(item)
            while images > _AHEAD:
                first = waiting.popleft()
                images -= isinstance(first.message, ReadAhead)
                yield first
        yield from waiting


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))
