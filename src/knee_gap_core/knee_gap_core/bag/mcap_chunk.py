"""The records of one chunk of an MCAP file, unpacked within bounds.

A few kilobytes can claim to hold gigabytes, or millions of empty records. What a chunk unpacks to, all
chunks of a file together, and the number of records are bounded by the size of what they come from.
"""

import io
import struct
import zlib
from collections.abc import Callable

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema

from knee_gap_core.bag.errors import BagError

# An image of 16 million colour pixels is 48 MB; recorders end a chunk after one such message.
MOST_CHUNK_BYTES = 256 << 20
# Definitions, metadata, parts of the index.
MOST_RECORD_BYTES = 16 << 20
# A file may unpack to so much, and to so many times its size more: images and poses pack to a third.
_FREE_BYTES = 1 << 30
_MOST_RATIO = 100
# And may hold so many records, and one more for so many of its bytes: a pose at rest packs to twelve.
_FREE_RECORDS = 200_000
_BYTES_PER_RECORD = 4

_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_RECORD_HEAD = struct.Struct("<BQ")


class Budget:
    """What the packed chunks of one file may come to together; a chunk read again is counted once."""

    def __init__(self, file_size: int) -> None:
        self._bytes_left = _FREE_BYTES + _MOST_RATIO * file_size
        self._records_left = _FREE_RECORDS + file_size // _BYTES_PER_RECORD
        self._bytes: dict[int, int] = {}
        self._records: dict[int, int] = {}

    def unpack(self, offset: int, size: int) -> None:
        """Take the size [bytes] that the chunk at an offset unpacks to. Raises BagError beyond the bounds."""
        more = size - self._bytes.get(offset, 0)
        if more > self._bytes_left:
            raise BagError(f"the file would unpack to more than {_MOST_RATIO} times its size")
        if more > 0:
            self._bytes_left -= more
            self._bytes[offset] = size

    def most_records(self, offset: int) -> int:
        """Return how many records the chunk at an offset may hold."""
        return self._records_left + self._records.get(offset, 0)

    def hold(self, offset: int, count: int) -> None:
        """Take the number of records in the chunk at an offset, at most `most_records`."""
        self._records_left -= count - self._records.get(offset, 0)
        self._records[offset] = count


def chunk_records(data: bytes, offset: int, budget: Budget) -> list[McapRecord]:
    """Return schemas, channels and messages of a chunk, whose record without its head is `data`.

    `offset` is its place in the file. Raises BagError, or what a parser raises on damaged bytes.
    """
    _, _, size, checksum, name_length = _HEAD.unpack_from(data)
    place = _HEAD.size + name_length
    compression = data[_HEAD.size : place].decode()
    (packed_length,) = _LENGTH.unpack_from(data, place)
    packed = data[place + _LENGTH.size : place + _LENGTH.size + packed_length]
    if len(packed) != packed_length:
        raise BagError("it is shorter than it claims")
    if size > MOST_CHUNK_BYTES:
        raise BagError(f"it would unpack to more than {MOST_CHUNK_BYTES >> 20} MiB")
    if compression:
        budget.unpack(offset, size)
    unpacked = _unpacked(compression, packed, size)
    if checksum and zlib.crc32(unpacked) != checksum:
        raise BagError("its checksum is wrong")
    places = _places(unpacked, budget.most_records(offset))
    budget.hold(offset, len(places))
    return [record for place in places if (record := _record(unpacked, *place)) is not None]


def cut_chunk_records(data: bytes, offset: int, budget: Budget) -> list[McapRecord]:
    """Return the records that are complete in a chunk whose end is missing.

    The checksum is of the whole chunk, so that these records cannot be checked.
    """
    _, _, size, _, name_length = _HEAD.unpack_from(data)
    place = _HEAD.size + name_length
    compression = data[_HEAD.size : place].decode()
    packed = data[place + _LENGTH.size :]
    size = min(size, MOST_CHUNK_BYTES)
    if compression:
        budget.unpack(offset, size)
    if compression == "zstd":
        unpacked = zstandard.ZstdDecompressor().decompressobj().decompress(packed)[:size]
    elif compression == "lz4":
        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
    else:
        unpacked = packed[:size]
    places = _places(unpacked, budget.most_records(offset), cut=True)
    budget.hold(offset, len(places))
    return [record for place in places if (record := _record(unpacked, *place)) is not None]


def _unpacked(compression: str, packed: bytes, size: int) -> bytes:
    """Return `packed` unpacked. Raises BagError where that has not the given size [bytes]."""
    if not compression:
        unpacked = packed
    elif compression == "zstd":
        # The frame's own claim of a size is believed by the decompressor: it is not asked.
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            unpacked = _up_to(stream.read, size)
    elif compression == "lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
        unpacked = decompressor.decompress(packed, max_length=size + 1)
    else:
        raise BagError(f"it is compressed by {compression[:20]!r}, which cannot be read")
    if len(unpacked) != size:
        raise BagError("it does not unpack to the size that it claims")
    return unpacked


def _up_to(read: Callable[[int], bytes], size: int) -> bytes:
    """Read until the end, or one byte more than `size`."""
    parts, left = [], size + 1
    while left > 0 and (part := read(left)):
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def _places(data: bytes, most: int, *, cut: bool = False) -> list[tuple[int, int, int]]:
    """Return kind, begin and end of each record of an unpacked chunk.

    Raises BagError where there are more than `most`, and where one is cut, unless the chunk may be `cut`.
    """
    places: list[tuple[int, int, int]] = []
    place, least = 0, _RECORD_HEAD.size
    while place < len(data):
        if place + least > len(data):
            if cut:
                break
            raise BagError("a record in it is cut")
        opcode, length = _RECORD_HEAD.unpack_from(data, place)
        begin, place = place + least, place + least + length
        if cut and place > len(data):
            break
        if opcode == 0 or place > len(data):
            raise BagError("a record in it is damaged")
        if len(places) >= most:
            raise BagError("the file holds more records than one of its size can")
        places.append((opcode, begin, place))
    return places


def _record(data: bytes, opcode: int, begin: int, end: int) -> McapRecord | None:
    """Return one record of an unpacked chunk; None for kinds that hold no messages."""
    stream = ReadDataStream(io.BytesIO(data[begin:end]))
    record: McapRecord | None = None
    if opcode == Opcode.MESSAGE:
        record = Message.read(stream, end - begin)
    elif opcode == Opcode.SCHEMA:
        record = Schema.read(stream)
    elif opcode == Opcode.CHANNEL:
        record = Channel.read(stream)
    return record
