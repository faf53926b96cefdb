"""Bags of ROS 2, written without ROS: a folder with `metadata.yaml` and MCAP files, named as rosbag2 does."""

import errno
import os
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from rosbags.interfaces import Qos

from knee_gap_core.bag.errors import BagError, DiskFullError
from knee_gap_core.bag.message_types import known_type, typestore
from knee_gap_core.bag.qos import PROFILES, QosName
from knee_gap_core.bag.writing.bag_metadata import (
    FileSummary,
    TopicSummary,
    information,
    qos_text,
    write_metadata,
    yaml_text,
)
from knee_gap_core.bag.writing.log_order import Logged, LogOrder
from knee_gap_core.bag.writing.mcap_storage import (
    METADATA_RECORD,
    ROSBAG2_RECORD,
    CompressionName,
    McapStorage,
    TopicRecord,
)
from knee_gap_core.user_files import flaw_of_new, reason_of, shown

# DDS pads what it sends; a bag written here and played and recorded again then has the same bytes.
_DDS_ALIGNMENT = 4
# Messages may be written so much out of the order of their times [ns].
SPAN_NS = 500_000_000
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Split(NamedTuple):
    """When a new file is begun: a size [bytes] and a duration [ns]; None for no limit."""

    most_bytes: int | None = None
    most_ns: int | None = None


class BagWriter:
    """Writes a new bag; a context manager.

    Messages are sorted by time over `span_ns`, and the log time never runs backwards; what is later is logged
    at the time of the last one written, and keeps its own as time of publishing. The same calls give the same
    bytes in every file, whatever the bag's name. What was written before an exception is kept and readable.
    To `replace` a bag removes its files, and keeps what else is in its folder.
    Raises BagError if `path` exists already, or is to be replaced and is not a bag, or cannot be made.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        metadata: Mapping[str, str] | None = None,
        compression: CompressionName = "none",
        split: Split | None = None,
        span_ns: int = SPAN_NS,
        replace: bool = False,
    ) -> None:
        self.path = Path(path)
        self.counts: Counter[str] = Counter()
        self._metadata = dict(metadata or {})
        self._compression: CompressionName = compression
        self._split = split or Split()
        self._order: LogOrder[tuple[str, bytes]] = LogOrder(span_ns)
        self._topics: dict[str, tuple[TopicRecord, tuple[Qos, ...]]] = {}
        self._files: list[FileSummary] = []
        self._written: Counter[str] = Counter()
        self._storage: McapStorage | None = None
        if flaw := _flaw_of_replaced(self.path) if replace else flaw_of_new(self.path):
            raise BagError(flaw)
        self._replace = replace

    def __enter__(self) -> Self:
        try:
            self.path.mkdir(mode=0o755, parents=True, exist_ok=self._replace)
            for name in _bag_files(self.path):
                (self.path / name).unlink()
            self._storage = self._next_storage()
            self._storage.flush()
        except OSError as error:
            raise BagError(f"{shown(self.path)} cannot be made: {reason_of(error)}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._drain()
            self._end_file()
            held = information(self._files, self._summaries(self._written), self._metadata, named=True)
            write_metadata(self.path, held)
        except (OSError, DiskFullError) as failure:
            if error is None:
                reason = reason_of(failure)
                raise BagError(f"{shown(self.path)} cannot be finished: {reason}") from None

    @property
    def pending_bytes(self) -> int:
        """Number of bytes that wait for space on the disk."""
        return self._open_storage.pending_bytes

    def add_topic(self, name: str, msgtype: str, qos: QosName | Sequence[Qos] = "reliable") -> None:
        """Announce a topic; again with the same type is allowed.

        `qos` is what its publisher offers: `sensor` (best effort), `reliable`, `latched` (kept for late
        subscribers), or the profiles themselves. Raises BagError for an unknown type or quality of service.
        """
        msgtype = known_type(msgtype)
        if isinstance(qos, str):
            if qos not in PROFILES:
                raise BagError(f"quality of service '{qos}' is unknown; valid are {', '.join(PROFILES)}")
            qos = [PROFILES[qos]]
        definition, _ = typestore().generate_msgdef(msgtype, ros_version=2)
        type_hash = typestore().hash_rihs01(msgtype)
        self.copy_topic(TopicRecord(name, msgtype, definition.encode(), type_hash), qos)

    def copy_topic(self, topic: TopicRecord, qos: Sequence[Qos]) -> None:
        """Announce a topic as another bag has it, whether its type is known here or not."""
        if (known := self._topics.get(topic.name)) is not None:
            if known[0].msgtype != topic.msgtype:
                raise BagError(f"topic {topic.name} has type {known[0].msgtype}, not {topic.msgtype}")
            return
        record = topic._replace(qos=qos_text(qos))
        self._topics[topic.name] = (record, tuple(qos))
        self.counts[topic.name] = 0
        self._open_storage.add_topic(record)

    def write(self, topic: str, message: object, time_ns: int) -> None:
        """Serialise a message of `knee_gap_core.bag.message_types` and write it with its time [ns]."""
        self.write_raw(topic, serialized(message, self._known(topic).msgtype), time_ns)

    def write_raw(self, topic: str, cdr_bytes: bytes | memoryview, time_ns: int) -> None:
        """Write a serialised message with its time [ns].

        Raises DiskFullError where the disk is full: the message then waits, and `flush` tries again.
        """
        self._known(topic)
        self.counts[topic] += 1
        self._log_all(self._order.push(time_ns, (topic, bytes(cdr_bytes))))

    def flush(self, *, drain: bool = True) -> None:
        """Hand everything so far to the operating system: it then survives the end of this process.

        Not to `drain` keeps back the messages that others may still precede. Raises DiskFullError.
        """
        if drain:
            self._drain()
        try:
            self._open_storage.flush()
        except OSError as error:
            raise self._unwritten(error) from None

    @property
    def _open_storage(self) -> McapStorage:
        assert self._storage is not None
        return self._storage

    def _known(self, topic: str) -> TopicRecord:
        try:
            return self._topics[topic][0]
        except KeyError:
            names = ", ".join(self._topics) or "none"
            raise BagError(f"topic {topic} was not added to {self.path}; added are {names}") from None

    def _drain(self) -> None:
        self._log_all(self._order.flush())

    def _log_all(self, messages: Iterator[Logged[tuple[str, bytes]]]) -> None:
        failure: OSError | None = None
        for log_ns, time_ns, (topic, data) in messages:
            try:
                self._log(log_ns, time_ns, topic, data)
            except OSError as error:
                failure = error
        if failure is not None:
            raise self._unwritten(failure)

    def _log(self, log_ns: int, time_ns: int, topic: str, data: bytes) -> None:
        storage = self._open_storage
        most_bytes, most_ns = self._split
        too_large = most_bytes is not None and storage.size + len(data) > most_bytes
        too_long = most_ns is not None and log_ns - storage.start_ns >= most_ns
        if storage.message_count and (too_large or too_long):
            self._end_file()
            self._storage = storage = self._next_storage()
        self._written[topic] += 1
        storage.write(topic, log_ns, time_ns, data)

    def _next_storage(self) -> McapStorage:
        name = os.path.basename(os.path.abspath(self.path))
        storage = McapStorage(self.path / f"{name}_{len(self._files)}.mcap", self._compression)
        # At once, so that a recording that is cut short still has it.
        begun = information((), (), self._metadata, named=False)
        storage.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": yaml_text(begun).strip()})
        if self._metadata:
            storage.add_metadata(METADATA_RECORD, self._metadata)
        for record, _ in self._topics.values():
            storage.add_topic(record)
        return storage

    def _end_file(self) -> None:
        storage = self._open_storage
        file = FileSummary(storage.path.name, storage.start_ns, storage.end_ns, storage.message_count)
        self._files.append(file)
        summaries = self._summaries(storage.counts)
        held = information([file], summaries, self._metadata, named=False)
        storage.close(yaml_text(held).strip())

    def _summaries(self, counts: Mapping[str, int]) -> list[TopicSummary]:
        return [
            TopicSummary(name, record.msgtype, qos, record.type_hash, record.serialization, counts[name])
            for name, (record, qos) in self._topics.items()
        ]

    def _unwritten(self, error: OSError) -> BagError:
        kind = DiskFullError if error.errno in _FULL else BagError
        return kind(f"{shown(self.path)}: {reason_of(error)}")


def serialized(message: object, msgtype: str) -> bytes:
    """Return a message of `knee_gap_core.bag.message_types` as a bag keeps it."""
    data = bytes(typestore().serialize_cdr(message, msgtype))
    return data + bytes(-len(data) % _DDS_ALIGNMENT)


def _flaw_of_replaced(path: Path) -> str:
    """Why `path` cannot be replaced by a new bag; empty where it can, or where there is nothing."""
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"{shown(path)}: {reason_of(error)}"
    if not stat.S_ISDIR(mode):
        return f"{shown(path)} is not the folder of a bag, and is not replaced"
    if os.listdir(path) and not _bag_files(path):
        return f"{shown(path)} is not a bag, and is not replaced"
    return ""


def _bag_files(folder: Path) -> list[str]:
    """Return the names of the files in a folder that are parts of a bag."""
    return [
        name for name in os.listdir(folder) if name == "metadata.yaml" or name.endswith((".mcap", ".db3"))
    ]
