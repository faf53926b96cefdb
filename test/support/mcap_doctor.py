"""What `mcap doctor --strict-message-order` checks, with MCAP's reference library."""

import zlib
from pathlib import Path

from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream


def records(path: Path) -> list[McapRecord]:
    """Return the records of a file, with its chunks whole; their checksums are checked."""
    with path.open("rb") as file:
        found = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    for chunk in (record for record in found if isinstance(record, Chunk)):
        data, _ = get_chunk_data_stream(chunk)
        assert chunk.uncompressed_crc == zlib.crc32(data.read(chunk.uncompressed_size)) != 0
    return found


def chunks(path: Path) -> list[tuple[Chunk, list[Message]]]:
    """Return the chunks of a file, each with its messages."""
    return [
        (chunk, [record for record in breakup_chunk(chunk) if isinstance(record, Message)])
        for chunk in records(path)
        if isinstance(chunk, Chunk)
    ]


def examine(path: Path) -> list[Message]:
    """Return the messages of a sound file in the order of the file; fails for one that is not sound."""
    found = records(path)
    assert isinstance(found[0], Header)
    assert found[0].profile == "ros2"
    assert isinstance(found[-1], Footer)
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    messages: list[Message] = []
    indexed = 0
    end_of_data = next(place for place, record in enumerate(found) if isinstance(record, DataEnd))
    for record in found[:end_of_data]:
        if isinstance(record, MessageIndex):
            indexed += len(record.records)
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            assert record.schema_id in schemas
            channels[record.id] = record
        if not isinstance(record, Chunk):
            continue
        inside: list[Message] = []
        for part in breakup_chunk(record):
            if isinstance(part, Schema):
                schemas[part.id] = part
            elif isinstance(part, Channel):
                assert part.schema_id in schemas
                channels[part.id] = part
            elif isinstance(part, Message):
                assert part.channel_id in channels
                inside.append(part)
        assert record.message_start_time == min(message.log_time for message in inside)
        assert record.message_end_time == max(message.log_time for message in inside)
        messages += inside
    times = [message.log_time for message in messages]
    assert times == sorted(times), "the log time runs backwards"
    assert indexed == len(messages)
    summary = found[end_of_data:]
    assert {one.id for one in summary if isinstance(one, Schema)} == set(schemas)
    assert {one.id for one in summary if isinstance(one, Channel)} == set(channels)
    indexes = [record for record in summary if isinstance(record, ChunkIndex)]
    assert len(indexes) == sum(isinstance(record, Chunk) for record in found)
    (statistics,) = (record for record in summary if isinstance(record, Statistics))
    assert statistics.message_count == len(messages)
    assert statistics.channel_count == len(channels)
    if messages:
        assert (statistics.message_start_time, statistics.message_end_time) == (times[0], times[-1])
    return messages
