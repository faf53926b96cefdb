"""The recorder's writing thread keeps the order, counts what it drops, and tells what went wrong."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import pytest
from rosbags.interfaces import Qos

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_replay.recording import WriterThread

TYPE = "std_msgs/msg/Float64"


def message(index: int, size: int = 12) -> BagMessage:
    return BagMessage("/number", TYPE, index, bytes([0, 1, 0, 0]) + index.to_bytes(size - 4, "little"))


def test_everything_taken_is_written_in_order(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        writer = WriterThread(bag)
        writer.add_topic("/number", TYPE, ())
        writer.start()
        for index in range(5000):
            writer.put(message(index))
        writer.finish()
        assert writer.error is None
    with BagReader(tmp_path / "bag") as reader:
        assert list(reader.messages()) == [message(index) for index in range(5000)]


def test_what_does_not_fit_into_memory_is_dropped_and_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        writer = WriterThread(bag, memory_bytes=1000)
        writer.add_topic("/number", TYPE, ())
        for index in range(15):
            writer.put(message(index, size=100))
        assert writer.dropped == {"/number": 5}
        writer.start()
        writer.finish()
    with BagReader(tmp_path / "bag") as reader:
        assert [m.time_ns for m in reader.messages()] == list(range(10))


def test_a_full_disk_ends_the_thread_with_its_reason() -> None:
    class FullDisk:
        def add_topic(self, name: str, msgtype: str, qos: Sequence[Qos]) -> None:
            raise OSError(28, "No space left on device")

    writer = WriterThread(cast(BagWriter, FullDisk()))
    writer.add_topic("/number", TYPE, ())
    writer.start()
    writer.finish()
    assert writer.error is not None
    with pytest.raises(OSError, match="No space left"):
        raise writer.error
