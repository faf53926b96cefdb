"""Bag writer in a thread of its own, so that a slow disk does not delay the receiving thread."""

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence

from rosbags.interfaces import Qos

from knee_gap_core.bag.bag import BagMessage, BagWriter
from knee_gap_core.bag.errors import DiskFullError

_LOG = logging.getLogger(__name__)
# Most data that is lost if the recorder is killed.
_FLUSH_SECONDS = 0.5
# Some seconds of raw video.
_MEMORY_BYTES = 512 * 1024 * 1024


class WriterThread(threading.Thread):
    """Queues messages without blocking and writes them in the order of arrival.

    A message that arrives while the queue is full is dropped and counted in `dropped`. On a full disk
    messages are kept in memory, within the same limit, until there is space again. Any other failure to write
    ends the thread and is kept in `error`.
    """

    def __init__(self, bag: BagWriter, memory_bytes: int = _MEMORY_BYTES) -> None:
        super().__init__(name="bag writer", daemon=True)
        self.dropped: Counter[str] = Counter()
        self.error: Exception | None = None
        self._bag = bag
        self._memory_bytes = memory_bytes
        self._put_bytes = self._written_bytes = 0
        # What the disk has no space for, and whether it has been reported.
        self._waiting_bytes = 0
        self._full = False
        self._queue: queue.SimpleQueue[BagMessage | tuple[str, str, Sequence[Qos]] | None] = (
            queue.SimpleQueue()
        )

    def add_topic(self, name: str, msgtype: str, qos: Sequence[Qos]) -> None:
        """Declare a topic, before its messages."""
        self._queue.put((name, msgtype, qos))

    def put(self, message: BagMessage) -> None:
        """Queue a message; returns at once."""
        if (
            self._put_bytes - self._written_bytes + self._waiting_bytes + len(message.data)
            > self._memory_bytes
        ):
            self.dropped[message.topic] += 1
            return
        self._put_bytes += len(message.data)
        self._queue.put(message)

    def finish(self) -> None:
        """Return when all queued messages are written."""
        self._queue.put(None)
        self.join()

    def run(self) -> None:
        """Write until `finish`."""
        try:
            self._write()
        except Exception as error:  # reported by the command, which then stops
            self.error = error

    def _write(self) -> None:
        flushed = time.monotonic()
        while True:
            idle = False
            try:
                item = self._queue.get(timeout=_FLUSH_SECONDS)
            except queue.Empty:
                item, idle = ("", "", ()), True
            if item is None:
                return
            try:
                self._take(item)
                if time.monotonic() - flushed > _FLUSH_SECONDS:
                    flushed = time.monotonic()
                    # While nothing arrives, nothing can come before what waits for its turn.
                    self._bag.flush(drain=idle)
                    if self._full:
                        self._full = False
                        _LOG.warning("there is space again; recording goes on")
            except DiskFullError as error:
                if not self._full:
                    self._full = True
                    _LOG.warning("%s; recording goes on in memory until there is space", error)
            self._waiting_bytes = self._bag.pending_bytes

    def _take(self, item: BagMessage | tuple[str, str, Sequence[Qos]]) -> None:
        if isinstance(item, BagMessage):
            self._written_bytes += len(item.data)
            self._bag.write_raw(item.topic, item.data, item.time_ns)
        elif item[0]:
            self._bag.add_topic(*item)
