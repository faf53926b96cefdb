"""Bags made to hang or to fill the memory are refused, or read without what is hostile, in bounded time."""

import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema

from knee_gap_core.bag import mcap_chunk, mcap_file
from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank

MAGIC = b"\x89MCAP0\r\n"
MSGTYPE = "std_msgs/msg/String"


def records(count: int, data: bytes = b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00\x00\x00") -> bytes:
    """Schema, channel and messages, as they lie in a chunk."""
    build = RecordBuilder()
    Schema(id=1, name=MSGTYPE, encoding="ros2msg", data=b"string data\n").write(build)
    Channel(id=1, topic="/text", message_encoding="cdr", metadata={}, schema_id=1).write(build)
    for index in range(count):
        Message(channel_id=1, log_time=index, publish_time=index, sequence=0, data=data).write(build)
    return build.end()


def chunk(unpacked: bytes, packed: bytes, compression: str, size: int | None = None) -> Chunk:
    return Chunk(
        compression=compression,
        data=packed,
        message_start_time=0,
        message_end_time=10**9,
        uncompressed_crc=zlib.crc32(unpacked),
        uncompressed_size=len(unpacked) if size is None else size,
    )


def mcap(path: Path, *chunks: Chunk) -> Path:
    """A file of chunks, without an index."""
    build = RecordBuilder()
    Header(profile="ros2", library="test").write(build)
    for one in chunks:
        one.write(build)
    DataEnd(data_section_crc=0).write(build)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(build)
    path.write_bytes(MAGIC + build.end() + MAGIC)
    return path


def zstd(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def zstd_of_zeros(size: int) -> bytes:
    """Zeros, packed without the size in the frame's head, as a stream is."""
    compressor = zstandard.ZstdCompressor().compressobj()
    parts = [compressor.compress(bytes(1 << 20)) for _ in range(size >> 20)]
    return b"".join([*parts, compressor.flush()])


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    begin = time.process_time()
    yield
    assert time.process_time() - begin < seconds


def read(path: Path) -> tuple[int, list[str]]:
    """The number of messages, and what was lost beside the index, which the files made here have not."""
    with BagReader(path) as reader:
        count = sum(1 for _ in reader.messages())
        return count, [line for line in reader.losses if "the index at the end" not in line]


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
def test_every_compression_is_read_within_the_bounds(tmp_path: Path, compression: str) -> None:
    pack: dict[str, Callable[[bytes], bytes]] = {"": bytes, "zstd": zstd, "lz4": lz4.frame.compress}
    whole = records(1000)
    good = chunk(whole, pack[compression](whole), compression)
    count, losses = read(mcap(tmp_path / "good.mcap", good, good))
    assert (count, losses) == (2000, [])


def test_a_chunk_that_unpacks_to_gigabytes_is_lost_and_the_others_are_read(tmp_path: Path) -> None:
    whole, packed = records(10), zstd_of_zeros(600 << 20)
    assert len(packed) < 100_000
    honest = chunk(b"", packed, "zstd", size=600 << 20)
    liar = chunk(b"", packed, "zstd", size=1000)
    good = chunk(whole, zstd(whole), "zstd")
    with at_most(5.0):
        count, losses = read(mcap(tmp_path / "bomb.mcap", honest, good, liar, good))
    assert count == 20
    assert len(losses) == 2
    assert "more than 256 MiB" in losses[0]
    assert "does not unpack to the size" in losses[1]


def test_a_frame_that_claims_gigabytes_does_not_get_them(tmp_path: Path) -> None:
    """The head of a zstd frame states a size, which decompressors are glad to allocate."""
    frame = bytearray(zstd(bytes(300)))
    magic, descriptor = bytes(frame[:4]), 0b1110_0000  # eight bytes of size, one segment
    lying = magic + bytes([descriptor]) + (200 << 30).to_bytes(8, "little") + bytes(frame[7:])
    count, losses = read(mcap(tmp_path / "claim.mcap", chunk(b"", lying, "zstd", size=300)))
    assert count == 0
    assert len(losses) == 1


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_many_bombs_have_one_budget(
    tmp_path: Path, compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_chunk, "_FREE_BYTES", 16 << 20)
    monkeypatch.setattr(mcap_chunk, "_MOST_RATIO", 2)
    size = 12 << 20
    packed = zstd_of_zeros(size) if compression == "zstd" else lz4.frame.compress(bytes(size))
    bomb = chunk(bytes(size), packed, compression)
    whole = records(10)
    path = mcap(tmp_path / "bombs.mcap", chunk(whole, whole, ""), *[bomb] * 300)
    bound = (16 << 20) + 2 * path.stat().st_size
    assert 300 * size > 20 * bound
    with at_most(10.0):
        count, losses = read(path)
    assert count == 10
    assert any("unpack to more than 2 times its size" in line for line in losses)


def test_a_bomb_of_tiny_records_is_refused(tmp_path: Path) -> None:
    empty = b"\x05" + (22).to_bytes(8, "little") + b"\x01\x00" + bytes(20)
    same = records(0) + empty * 2_000_000
    bomb = chunk(same, zstd(same), "zstd")
    assert len(bomb.data) < 30_000
    with at_most(30.0):
        count, losses = read(mcap(tmp_path / "bomb.mcap", bomb))
    assert count == 0
    assert "more records than one of its size can" in losses[0]


def test_a_chunk_read_again_costs_nothing_of_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_chunk, "_FREE_BYTES", 100_000)
    monkeypatch.setattr(mcap_chunk, "_FREE_RECORDS", 2_000)
    monkeypatch.setattr(mcap_chunk, "_MOST_RATIO", 0)
    monkeypatch.setattr(mcap_chunk, "_BYTES_PER_RECORD", 1 << 40)
    whole = records(1000)
    with BagReader(mcap(tmp_path / "loop.mcap", chunk(whole, zstd(whole), "zstd"))) as reader:
        for _ in range(5):
            assert sum(1 for _ in reader.messages()) == 1000
        assert [line for line in reader.losses if "index" not in line] == []


def test_blocks_that_all_begin_at_once_are_not_all_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "_MOST_WAITING_BYTES", 200_000)
    whole = records(1000, bytes(100))
    path = mcap(tmp_path / "overlap.mcap", *[chunk(whole, whole, "")] * 30)
    seen = {"most": 0}
    original = mcap_file.McapFile.read
    held: list[int] = []

    def counted(self: mcap_file.McapFile, block: mcap_file.Block) -> list[mcap_file.Entry]:
        entries = original(self, block)
        held.append(len(entries))
        return entries

    monkeypatch.setattr(mcap_file.McapFile, "read", counted)
    given = 0
    with BagReader(path) as reader:
        for _ in reader.messages():
            given += 1
            seen["most"] = max(seen["most"], sum(held) - given)
    assert given == 30_000
    assert seen["most"] < 5_000


def test_an_index_that_holds_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    whole = records(10)
    good = chunk(whole, whole, "")
    build = RecordBuilder()
    Header(profile="ros2", library="test").write(build)
    good.write(build)
    DataEnd(data_section_crc=0).write(build)
    body = build.end()
    Channel(id=1, topic="/text", message_encoding="cdr", metadata={}, schema_id=1).write(build)
    chunk(b"", zstd_of_zeros(600 << 20), "zstd", size=1 << 40).write(build)
    Footer(summary_start=len(MAGIC) + len(body), summary_offset_start=0, summary_crc=0).write(build)
    (tmp_path / "index.mcap").write_bytes(MAGIC + body + build.end() + MAGIC)
    with at_most(5.0):
        assert read(tmp_path / "index.mcap")[0] in (0, 10)


def bag(path: Path) -> Path:
    with BagWriter(path) as writer:
        writer.add_topic("/text", MSGTYPE)
        message = blank(MSGTYPE)
        message.data = "a"
        for index in range(10):
            writer.write("/text", message, index)
    return path


def test_a_fifo_in_a_bag_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    os.mkfifo(folder / "a.mcap")
    with pytest.raises(BagError, match=r"a\.mcap is a FIFO, not a file"):
        BagReader(folder)
    with pytest.raises(BagError, match=r"a\.mcap is a FIFO, not a file"):
        BagReader(folder / "a.mcap")
    with pytest.raises(BagError, match="is a device, not a file"):
        BagReader("/dev/zero")
    (folder / "a.mcap").unlink()
    (folder / "a.mcap").symlink_to("/dev/zero")
    with pytest.raises(BagError, match="is a device, not a file"):
        BagReader(folder)


@pytest.mark.parametrize(
    "content",
    [
        "[" * 100_000,
        "rosbag2_bagfile_information: &a [*a]",
        "rosbag2_bagfile_information: 3",
        "rosbag2_bagfile_information: {storage_identifier: mcap, compression_mode: 7}",
        "null",
        None,
    ],
)
def test_metadata_that_cannot_be_read_hides_no_message(tmp_path: Path, content: str | None) -> None:
    folder = bag(tmp_path / "bag")
    (folder / "metadata.yaml").unlink()
    if content is None:
        os.mkfifo(folder / "metadata.yaml")
    else:
        (folder / "metadata.yaml").write_text(content)
    assert read(folder) == (10, ["metadata.yaml is damaged; read without it"])


@pytest.mark.parametrize(
    "lines",
    [
        "relative_file_paths: 7",
        "relative_file_paths: bag.mcap",
        "relative_file_paths: [../bag/bag.mcap, bag.mcap]",
        "custom_data: [1, 2]",
        "custom_data: {1: 2, a: [b], c: null}",
        "custom_data: text",
    ],
)
def test_metadata_of_the_wrong_kinds_hides_no_message(tmp_path: Path, lines: str) -> None:
    folder = bag(tmp_path / "bag")
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  storage_identifier: mcap\n  {lines}\n"
    )
    with BagReader(folder) as reader:
        assert sum(1 for _ in reader.messages()) == 10
        assert all(isinstance(value, str) for value in reader.metadata.values())


def test_a_bag_is_not_written_through_a_dangling_link(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to("nowhere")
    with pytest.raises(BagError, match="is a link that leads nowhere"):
        BagWriter(tmp_path / "out")
    (tmp_path / "late").parent.mkdir(exist_ok=True)
    writer = BagWriter(tmp_path / "late")
    (tmp_path / "late").symlink_to("nowhere")
    with pytest.raises(BagError, match="cannot be made"):
        writer.__enter__()


def test_a_bomb_is_read_in_bounded_memory(tmp_path: Path) -> None:
    """In a process that may take one gigabyte beside what its libraries map."""
    packed = zstd_of_zeros(250 << 20)
    bombs = [chunk(bytes(250 << 20), packed, "zstd")] * 6
    path = mcap(tmp_path / "bombs.mcap", *bombs)
    program = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from knee_gap_core.bag.bag import BagReader\n"
        "with BagReader(sys.argv[1]) as reader:\n"
        "    list(reader.messages())\n"
        "    status = Path('/proc/self/status').read_text()\n"
        "    print(len(reader.losses), re.search(r'VmHWM:\\s*(\\d+)', status)[1])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True, timeout=120
    )
    lost, peak_kib = (int(word) for word in done.stdout.split())
    assert lost >= 1
    assert peak_kib < 1 << 20
