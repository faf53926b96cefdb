"""One MCAP file, whole, cut or damaged: its blocks of messages, in order of time.

Blocks are found by the index at the end, or, where it is missing or damaged, by a walk over the heads of the
records. What cannot be read is named once, in one line, and everything else is given.
"""

import heapq
import io
import logging
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.mcap_chunk import (
    MOST_CHUNK_BYTES,
    MOST_RECORD_BYTES,
    Budget,
    chunk_records,
    cut_chunk_records,
)
from knee_gap_core.user_files import FileError, open_file, shown

_LOG = logging.getLogger(__name__)
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
_TIMES = struct.Struct("<QQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<BQQQI")
_END_SIZE = _FOOTER.size + MAGIC_SIZE
_CHECKSUM_SIZE = 4
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_INDEX_ENTRY_SIZE = 16
_INDEX_HEAD_SIZE = 6
# Records of the index, and messages that wait for their turn in time, held in memory at most.
_MOST_INDEX_BYTES = 128 << 20
_MOST_WAITING_BYTES = 512 << 20


class Block(NamedTuple):
    """A record that holds messages: a chunk, or a single message of a file without chunks.

    `channels` are those of its messages, None if the file does not state them.
    """

    start_ns: int
    offset: int
    length: int
    is_chunk: bool
    message_count: int
    end_ns: int
    channels: frozenset[int] | None = None


class Entry(NamedTuple):
    """One message as the file has it."""

    time_ns: int
    topic: str
    schema_name: str
    data: bytes


class McapFile:
    """The readable part of one MCAP file.

    `counts` are the messages by topic, as the index counts them; None without one. `losses` has one line for
    each part that is not readable; it grows while blocks are read. Raises BagError where the file is no MCAP
    file at all or cannot be opened. To `salvage` is to read what is complete in a chunk that is cut, too.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path = path
        self._salvage = salvage
        self.losses: list[str] = []
        self._reported: set[str] = set()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.blocks: list[Block] = []
        self.counts: Counter[str] | None = None
        try:
            self._file: BinaryIO = open_file(path)
        except FileError as error:
            raise BagError(str(error)) from None
        self._size = os.fstat(self._file.fileno()).st_size
        self._budget = Budget(self._size)
        try:
            self._open()
        except OSError as error:
            self._file.close()
            raise BagError(f"{shown(path)}: {error.strerror}") from None
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, block: Block) -> list[Entry]:
        """Return the messages of a block, in the order of the file; none, and a loss, where it is damaged."""
        try:
            records = self._records(block)
        except Exception as error:  # every decompressor and parser fails in its own way on damaged bytes
            reason = str(error) or type(error).__name__
            self._lose(f"{block.message_count or 'all'} messages at byte {block.offset} lost: {reason}")
            return []
        self._note_definitions(records)
        messages = [record for record in records if isinstance(record, Message)]
        # Without an index a topic is announced in one chunk only, and that may be the damaged one.
        known = [message for message in messages if message.channel_id in self.channels]
        if len(known) < len(messages):
            self._lose(
                f"{len(messages) - len(known)} messages at byte {block.offset} lost: their topic is unknown"
            )
        return [self._entry(message) for message in known]

    def _entry(self, message: Message) -> Entry:
        channel = self.channels[message.channel_id]
        schema = self.schemas.get(channel.schema_id)
        return Entry(message.log_time, channel.topic, schema.name if schema else "", message.data)

    def _open(self) -> None:
        if self._size == 0:
            raise BagError(f"{shown(self.path)} is empty")
        head = self._file.read(MAGIC_SIZE + 1)
        if head[:MAGIC_SIZE] != _MAGIC:
            if head[MAGIC_SIZE:] != bytes([Opcode.HEADER]):
                raise BagError(f"{shown(self.path)} is not an MCAP file")
            self._lose("the first bytes of the file are damaged")
        summary = self._summary()
        if summary is not None and summary.chunk_indexes:
            self._use_index(summary)
        else:
            self._walk()
        if summary is not None:
            self.schemas.update(summary.schemas)
            self.channels.update(summary.channels)
            if summary.statistics is not None:
                self.counts = Counter()
                for number, count in summary.statistics.channel_message_counts.items():
                    if (channel := summary.channels.get(number)) is not None:
                        self.counts[channel.topic] += count
        else:
            for block in self.blocks:
                if block.is_chunk:
                    self._peek_definitions(block)
        self.blocks.sort()

    def _summary(self) -> Summary | None:
        """Return the index at the end of the file, None where it is absent or damaged."""
        try:
            self._file.seek(-_END_SIZE, os.SEEK_END)
            _, _, start, _, known = _FOOTER.unpack(self._file.read(_FOOTER.size))
            if not start > MAGIC_SIZE or self._size - start > _MOST_INDEX_BYTES:
                return None
            self._file.seek(start)
            tail = self._file.read(self._size - start)
            is_sound = known in (0, zlib.crc32(tail[: -MAGIC_SIZE - _CHECKSUM_SIZE]))
            summary = _summary_of(tail) if is_sound else None
        except Exception:  # a cut or damaged end fails in many ways; the walk finds what is lost
            return None
        return summary if summary is not None and summary.channels else None

    def _use_index(self, summary: Summary) -> None:
        """Take the blocks from the index, and metadata from the place that it gives."""
        for chunk in summary.chunk_indexes:
            # Each channel has one record: its head, its own, and an entry for each message.
            heads = len(chunk.message_index_offsets) * (_RECORD_HEAD.size + _INDEX_HEAD_SIZE)
            count = max(0, chunk.message_index_length - heads) // _INDEX_ENTRY_SIZE
            length = chunk.chunk_length - _RECORD_HEAD.size
            start_ns, end_ns = chunk.message_start_time, chunk.message_end_time
            channels = frozenset(chunk.message_index_offsets)
            block = Block(start_ns, chunk.chunk_start_offset, length, True, count, end_ns, channels)
            self.blocks.append(block)
        for index in summary.metadata_indexes:
            self._file.seek(index.offset + _RECORD_HEAD.size)
            self._note(Opcode.METADATA, index.offset, index.length)

    def _walk(self) -> None:
        """Collect the blocks from the heads of the records, up to where they end or are damaged."""
        offset = MAGIC_SIZE
        while offset < self._size:
            self._file.seek(offset)
            head = self._file.read(_RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                break
            opcode, length = _RECORD_HEAD.unpack(head)
            end = offset + _RECORD_HEAD.size + length
            is_misplaced = opcode == Opcode.MESSAGE and any(block.is_chunk for block in self.blocks[:1])
            if end > self._size or opcode not in _OPCODES or is_misplaced:
                if self._salvage and opcode == Opcode.CHUNK and end > self._size:
                    self._note(opcode, offset, length)
                break
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                if opcode == Opcode.DATA_END and self.blocks and self.blocks[0].is_chunk:
                    self._note_lost_index(end)
                return
            self._note(opcode, offset, length)
            offset = end
        rest = self._size - offset
        self._lose(f"cut or damaged at byte {offset}: {rest} bytes lost" if rest else "ends without an index")

    def _note_lost_index(self, end_of_data: int) -> None:
        """Note that the index is damaged, unless the file was written without one."""
        self._file.seek(-_END_SIZE, os.SEEK_END)
        opcode, _, index_start, *_ = _FOOTER.unpack(self._file.read(_FOOTER.size))
        # What follows the data must be the end of the file, or an index that is sound and lists no chunks.
        ends_here = opcode == Opcode.FOOTER and index_start == 0 and end_of_data == self._size - _END_SIZE
        if not ends_here and not (end_of_data == index_start and self._summary() is not None):
            self._lose("the index at the end is damaged; read without it")

    def _note(self, opcode: int, offset: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            start_ns, end_ns = _TIMES.unpack(self._file.read(_TIMES.size))
            self.blocks.append(Block(start_ns, offset, length, True, 0, end_ns))
        elif opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
            self.blocks.append(Block(time_ns, offset, length, False, 1, time_ns, frozenset({channel})))
        elif opcode == Opcode.MESSAGE_INDEX and self.blocks:
            entries = max(0, length - _INDEX_HEAD_SIZE) // _INDEX_ENTRY_SIZE
            self.blocks[-1] = self.blocks[-1]._replace(message_count=self.blocks[-1].message_count + entries)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            try:
                if length > MOST_RECORD_BYTES:
                    raise BagError("it is too long")
                stream = ReadDataStream(io.BytesIO(self._file.read(length)))
                if opcode == Opcode.METADATA:
                    record = Metadata.read(stream)
                    self.metadata[record.name] = dict(record.metadata)
                else:
                    self._note_definitions([(Schema if opcode == Opcode.SCHEMA else Channel).read(stream)])
            except Exception:  # damaged strings and lengths fail in many ways
                self._lose(f"the {Opcode(opcode).name.lower()} at byte {offset} is damaged")

    def _records(self, block: Block) -> list[McapRecord]:
        self._file.seek(block.offset)
        opcode, length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))
        if length != block.length or opcode != (Opcode.CHUNK if block.is_chunk else Opcode.MESSAGE):
            raise BagError("its head is damaged")
        if length > MOST_CHUNK_BYTES and not self._salvage:
            raise BagError(f"longer than {MOST_CHUNK_BYTES >> 20} MiB")
        data = self._file.read(min(length, MOST_CHUNK_BYTES))
        if len(data) < length:
            if self._salvage and block.is_chunk:
                return cut_chunk_records(data, block.offset, self._budget)
            raise BagError("the file ends in it")
        if not block.is_chunk:
            return [Message.read(ReadDataStream(io.BytesIO(data)), length)]
        return chunk_records(data, block.offset, self._budget)

    def _peek_definitions(self, block: Block) -> None:
        try:
            self._note_definitions(self._records(block))
        except Exception:  # reported when the block is read
            return

    def _note_definitions(self, records: Iterable[McapRecord]) -> None:
        for record in records:
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self.channels.setdefault(record.id, record)

    def _lose(self, what: str) -> None:
        line = f"{self.path.name}: {what}"
        if line not in self._reported:  # read again, it is lost again
            self._reported.add(line)
            self.losses.append(line)
            _LOG.warning(line)


def _summary_of(tail: bytes) -> Summary:
    """Return the index whose records, the footer and the magic are `tail`."""
    summary = Summary()
    # A chunk has no place here, and is not unpacked.
    for record in StreamReader(io.BytesIO(tail), skip_magic=True, emit_chunks=True).records:
        if isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, MetadataIndex):
            summary.metadata_indexes.append(record)
    return summary


class BagFile(Protocol):
    """One file of a bag, in whatever storage."""

    path: Path
    losses: list[str]
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    metadata: dict[str, dict[str, str]]
    blocks: list[Block]
    counts: Counter[str] | None

    def read(self, block: Block) -> list[Entry]:
        """Return the messages of a block."""

    def close(self) -> None:
        """Close the file."""


class Since(NamedTuple):
    """From when messages are wanted [ns], and the topics of which those before are wanted all the same."""

    begin_ns: int
    topics: frozenset[str]

    def wants(self, file: BagFile, block: Block) -> bool:
        """Whether a block may hold a message that is wanted."""
        # Some writers leave the end of a chunk out.
        if block.end_ns >= self.begin_ns or block.end_ns < block.start_ns:
            return True
        if block.channels is None:
            return bool(self.topics)
        held = (file.channels.get(number) for number in block.channels)
        return any(channel is not None and channel.topic in self.topics for channel in held)


def in_time_order(
    files: Iterable[BagFile], topics: Collection[str] | None, since: Since | None = None
) -> Iterator[Entry]:
    """Yield the messages of all files, by time, then file, then place; holds only blocks that overlap.

    Blocks without a message `since` then are not read; of the others all messages are given.
    """
    by_number: Mapping[int, BagFile] = dict(enumerate(files))
    blocks = sorted(
        (block.start_ns, number, block)
        for number, file in by_number.items()
        for block in file.blocks
        if since is None or since.wants(file, block)
    )
    waiting: list[tuple[int, int, int, int, Entry]] = []
    waiting_bytes = 0
    for start_ns, number, block in blocks:
        # Blocks of a recorder overlap by seconds at most; of a file that claims more, not all is held.
        while waiting and (waiting[0][0] < start_ns or waiting_bytes > _MOST_WAITING_BYTES):
            waiting_bytes -= len(waiting[0][-1].data)
            yield heapq.heappop(waiting)[-1]
        for place, entry in enumerate(by_number[number].read(block)):
            if topics is None or entry.topic in topics:
                waiting_bytes += len(entry.data)
                heapq.heappush(waiting, (entry.time_ns, number, block.offset, place, entry))
    while waiting:
        yield heapq.heappop(waiting)[-1]


def storage_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a folder, else its SQLite files, in the order of their numbers."""

    def key(path: Path) -> tuple[str, int]:
        stem, _, number = path.stem.rpartition("_")
        return (stem, int(number)) if number.isdecimal() else (path.stem, -1)

    names = os.listdir(folder)
    for suffix in (".mcap", ".db3"):
        if files := [folder / name for name in names if name.endswith(suffix)]:
            return sorted(files, key=key)
    return []
