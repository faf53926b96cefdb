"""One MCAP file of a bag, written in short chunks with a checksum on each.

A file that is cut short loses its last chunk only. A byte flipped on disk is found by the chunk's checksum.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from knee_gap_core.bag.writing.pending_file import PendingFile

METADATA_RECORD = "knee_gap"
ROSBAG2_RECORD = "rosbag2"
CompressionName = Literal["none", "lz4", "zstd"]
COMPRESSIONS: dict[CompressionName, CompressionType] = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
# A chunk holds at most so much, unless a single message is longer, and so long a time [ns].
CHUNK_BYTES = 1_000_000
CHUNK_NS = 1_000_000_000
# Of a message besides its data, and of a chunk without any.
_MESSAGE_HEAD_BYTES = 31
_UNLIMITED = 1 << 62


class TopicRecord(NamedTuple):
    """A topic as MCAP keeps it."""

    name: str
    msgtype: str
    definition: bytes
    type_hash: str
    qos: str = ""
    serialization: str = "cdr"
    encoding: str = "ros2msg"


class McapStorage:
    """Writes one MCAP file. What `flush` has handed over survives the end of this process."""

    def __init__(self, path: Path, compression: CompressionName) -> None:
        self.path = path
        self.start_ns = self.end_ns = 0
        self.counts: dict[str, int] = {}
        self._file = PendingFile(path)
        # The end of each chunk is decided here.
        self._writer = Writer(
            cast(Any, self._file), chunk_size=_UNLIMITED, compression=COMPRESSIONS[compression]
        )
        self._writer.start(profile="ros2", library="knee_gap_core")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._chunk_bytes = self._definition_bytes = 0
        self._chunk_start_ns: int | None = None
        # Definitions of the chunk begun, which is written once it holds a message.
        self._definitions: list[Schema | Channel] = []

    @property
    def message_count(self) -> int:
        """Number of messages written."""
        return sum(self.counts.values())

    @property
    def pending_bytes(self) -> int:
        """Number of bytes that could not be handed to the operating system yet."""
        return self._file.pending_bytes

    @property
    def size(self) -> int:
        """Number of bytes of the file, those of the chunk begun included."""
        return self._file.tell() + self._chunk_bytes

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write free metadata."""
        self._writer.add_metadata(name, dict(metadata))

    def add_topic(self, topic: TopicRecord) -> None:
        """Write a topic and the definition of its type."""
        if topic.msgtype not in self._schemas:
            self._schemas[topic.msgtype] = self._writer.register_schema(
                topic.msgtype, topic.encoding, topic.definition
            )
            number = self._schemas[topic.msgtype]
            self._definitions.append(Schema(number, topic.definition, topic.encoding, topic.msgtype))
            self._chunk_bytes += len(topic.definition) + _MESSAGE_HEAD_BYTES
        schema = self._schemas[topic.msgtype]
        metadata = {"offered_qos_profiles": topic.qos, "topic_type_hash": topic.type_hash}
        number = self._writer.register_channel(topic.name, topic.serialization, schema, metadata)
        self._channels[topic.name] = number
        self._definitions.append(Channel(number, topic.name, topic.serialization, metadata, schema))
        self._chunk_bytes += len(topic.qos) + len(topic.name) + _MESSAGE_HEAD_BYTES
        self.counts[topic.name] = 0

    def write(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Write one serialised message. Raises OSError where a chunk that ends does not fit on the disk.

        The message is then kept all the same, and written with the next `flush` that succeeds.
        """
        length = len(data) + _MESSAGE_HEAD_BYTES
        begun = self._chunk_start_ns
        is_full = self._chunk_bytes + length > CHUNK_BYTES or (
            begun is not None and log_ns - begun >= CHUNK_NS
        )
        error: OSError | None = None
        if begun is not None and is_full:
            try:
                self.flush()
            except OSError as failure:
                error = failure
        self._add(topic, log_ns, publish_ns, data, length)
        if error is not None:
            raise error

    def flush(self) -> None:
        """End the chunk begun and hand it to the operating system."""
        if self._chunk_start_ns is not None:
            self._definitions.clear()
        self._chunk_bytes, self._chunk_start_ns = 0, None
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it so

    def close(self, metadata: str) -> None:
        """Write rosbag2's metadata, the index and the end. Raises OSError where they do not fit."""
        try:
            self.flush()
            self._write_definitions()
            self._writer.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": metadata})
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it so
            self._file.flush()
        finally:
            self._file.close()

    def _write_definitions(self) -> None:
        """Write what was announced after the last message, since the index names it and no chunk holds it."""
        builder = RecordBuilder()
        for record in self._definitions:
            record.write(builder)
        self._file.write(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it so

    def _add(self, topic: str, log_ns: int, publish_ns: int, data: bytes, length: int) -> None:
        if self._chunk_start_ns is None:
            self._chunk_start_ns = log_ns
        if not self.message_count:
            self.start_ns = log_ns
        self.end_ns = log_ns
        self._chunk_bytes += length
        self._writer.add_message(self._channels[topic], log_ns, data, publish_ns)
        self.counts[topic] += 1
