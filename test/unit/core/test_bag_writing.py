"""What the writer promises of its files: short chunks, order, names, metadata; a full disk is survived."""

import errno
import os
from pathlib import Path

import mcap_doctor
import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError, DiskFullError
from knee_gap_core.bag.writing import pending_file
from knee_gap_core.bag.writing.bag_writer import Split

TYPE = "std_msgs/msg/Float64"
MS = 1_000_000
CDR = bytes([0, 1, 0, 0])


def data(index: int, size: int = 12) -> bytes:
    return CDR + index.to_bytes(size - 4, "little")


def write(path: Path, times_ns: list[int], size: int = 12, **options: object) -> Path:
    with BagWriter(path, metadata={"scene": "known"}, **options) as bag:  # type: ignore[arg-type]
        bag.add_topic("/number", TYPE, "sensor")
        for index, time_ns in enumerate(times_ns):
            bag.write_raw("/number", data(index, size), time_ns)
    return path


@pytest.mark.parametrize(
    ("period_ms", "size"), [(1, 12), (400, 12), (2000, 12), (1, 90_000), (300, 90_000), (5, 2_500_000)]
)
def test_a_chunk_holds_a_second_and_a_megabyte_at_most(tmp_path: Path, period_ms: int, size: int) -> None:
    count = 40 if size > 1_000_000 else 3000 if size < 1000 else 60
    bag = write(tmp_path / "bag", [k * period_ms * MS for k in range(count)], size)
    found = mcap_doctor.chunks(bag / "bag_0.mcap")
    for chunk, messages in found:
        assert chunk.message_end_time - chunk.message_start_time < 1_000 * MS
        assert chunk.uncompressed_size <= 1_000_000 or len(messages) == 1
    assert sum(len(messages) for _, messages in found) == count
    # Not shorter than need be either.
    assert len(found) <= 2 + 2 * count * max(period_ms / 1000, size / 1e6)


def test_messages_out_of_order_are_logged_in_order_and_keep_their_times(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    times = [k * 10 * MS + int(rng.integers(0, 300)) * MS for k in range(500)]
    times[300] = 1 * MS  # far too late
    bag = write(tmp_path / "bag", times)
    messages = mcap_doctor.examine(bag / "bag_0.mcap")
    assert sorted(m.publish_time for m in messages) == sorted(times)
    moved = [m for m in messages if m.log_time != m.publish_time]
    assert [m.publish_time for m in moved] == [1 * MS]
    assert 2_000 * MS < moved[0].log_time < 3_300 * MS


@pytest.mark.parametrize("count", [0, 3])
def test_topics_announced_after_the_last_message_are_in_the_file(count: int, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/number", TYPE)
        for index in range(count):
            bag.write_raw("/number", data(index), index * MS)
        bag.flush()
        bag.add_topic("/late", "geometry_msgs/msg/PoseStamped", "latched")
        bag.flush()
    assert len(mcap_doctor.examine(tmp_path / "bag" / "bag_0.mcap")) == count
    with BagReader(tmp_path / "bag") as reader:
        assert reader.topics == {"/number": TYPE, "/late": "geometry_msgs/msg/PoseStamped"}
        assert len(list(reader.messages())) == count
        assert not reader.losses


def test_messages_of_one_time_keep_their_order(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [7 * MS] * 50)
    with BagReader(bag) as reader:
        assert [m.data for m in reader.messages()] == [data(index) for index in range(50)]


def test_the_bytes_of_the_file_do_not_depend_on_name_and_place(tmp_path: Path) -> None:
    times = [k * 7 * MS for k in range(400)]
    first = write(tmp_path / "one", times)
    second = write(tmp_path / "deep" / "er" / "another_name", times)
    assert (first / "one_0.mcap").read_bytes() == (second / "another_name_0.mcap").read_bytes()
    before, after = ((path / "metadata.yaml").read_text() for path in (first, second))
    assert before.replace("one_0", "another_name_0") == after


def test_metadata_is_that_of_the_files(tmp_path: Path) -> None:
    split = Split(most_ns=1_000 * MS)
    bag = write(tmp_path / "bag", [k * 100 * MS + 5 for k in range(25)], split=split)
    names = ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert sorted(path.name for path in bag.iterdir()) == [*names, "metadata.yaml"]
    held = YAML(typ="safe").load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert held["relative_file_paths"] == names
    assert held["message_count"] == 25
    assert held["starting_time"]["nanoseconds_since_epoch"] == 5
    assert held["duration"]["nanoseconds"] == 2_400 * MS
    assert [file["message_count"] for file in held["files"]] == [10, 10, 5]
    assert [file["path"] for file in held["files"]] == names
    assert held["custom_data"] == {"scene": "known"}
    for name in names:
        mcap_doctor.examine(bag / name)
    with Reader(bag) as reader:
        assert reader.message_count == 25
        assert [entry[2] for entry in reader.messages()] == [data(index) for index in range(25)]
    with BagReader(bag / "bag_1.mcap") as reader:
        assert reader.metadata == {"scene": "known"}
        assert reader.count() == 10


def test_a_file_is_split_before_it_grows_too_large(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [k * MS for k in range(60)], 90_000, split=Split(most_bytes=2_000_000))
    sizes = [path.stat().st_size for path in sorted(bag.glob("*.mcap"))]
    assert len(sizes) == 3
    assert max(sizes) <= 2_000_000 + 10_000


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_compression_is_read_back(tmp_path: Path, compression: str) -> None:
    bag = write(tmp_path / "bag", [k * 10 * MS for k in range(300)], 200, compression=compression)
    assert {chunk.compression for chunk, _ in mcap_doctor.chunks(bag / "bag_0.mcap")} == {
        compression.replace("none", "")
    }
    with BagReader(bag) as reader:
        assert [m.data for m in reader.messages()] == [data(index, 200) for index in range(300)]


def test_a_bag_is_replaced_only_on_demand_and_nothing_else_is(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [k * 400 * MS for k in range(9)], split=Split(most_ns=1_000 * MS))
    (bag / "notes.txt").write_text("mine")
    with pytest.raises(BagError, match="exists already"):
        BagWriter(bag)
    write(bag, [1, 2], replace=True)
    assert sorted(path.name for path in bag.iterdir()) == ["bag_0.mcap", "metadata.yaml", "notes.txt"]
    with BagReader(bag) as reader:
        assert reader.count() == 2
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name in ("folder", "file"):
        with pytest.raises(BagError, match=r"is not .*, and is not replaced"):
            BagWriter(tmp_path / name, replace=True)
    assert (tmp_path / "folder" / "thesis.txt").read_text() == (tmp_path / "file").read_text() == "mine"


class SmallDisk:
    """A disk with so much space; takes the place of os.pwrite."""

    def __init__(self, space: int) -> None:
        self.space = space
        self.pwrite = os.pwrite

    def __call__(self, descriptor: int, content: bytes, offset: int) -> int:
        if self.space == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken = self.pwrite(descriptor, content[: self.space], offset)
        self.space -= taken
        return taken


def test_a_full_disk_is_told_and_loses_nothing_if_there_is_space_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = SmallDisk(1_500_000)
    monkeypatch.setattr(pending_file.os, "pwrite", disk)
    refused = 0
    with BagWriter(tmp_path / "bag", span_ns=0) as bag:
        bag.add_topic("/number", TYPE)
        for index in range(40):
            if index == 30:
                disk.space = 1 << 30
            try:
                bag.write_raw("/number", data(index, 100_000), index)
            except DiskFullError:
                refused += 1
            if index == 29:
                with BagReader(tmp_path / "bag") as reader:  # whole chunks, and no half one
                    assert len(list(reader.messages())) == 9
                assert bag.pending_bytes > 1_000_000
    assert refused == 2
    mcap_doctor.examine(tmp_path / "bag" / "bag_0.mcap")
    with BagReader(tmp_path / "bag") as reader:
        assert [m.data for m in reader.messages()] == [data(index, 100_000) for index in range(40)]


def test_a_bag_that_cannot_be_finished_stays_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pending_file.os, "pwrite", SmallDisk(1_500_000))
    with pytest.raises(BagError, match="cannot be finished: No space left"):
        write_until_full(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as reader:
        assert [m.data for m in reader.messages()] == [data(index, 100_000) for index in range(9)]


def write_until_full(path: Path) -> None:
    with BagWriter(path, span_ns=0) as bag:
        bag.add_topic("/number", TYPE)
        for index in range(15):
            bag.write_raw("/number", data(index, 100_000), index)
