"""The recorder's writing thread keeps the order, counts what it drops, and reports what went wrong."""

import errno
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import mcap_doctor
import pytest
from rosbags.interfaces import Qos

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_core.bag.writing import pending_file
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


def test_a_disk_that_is_full_for_a_while_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    is_full = threading.Event()
    pwrite = os.pwrite

    def write(descriptor: int, content: bytes, offset: int) -> int:
        if is_full.is_set():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return pwrite(descriptor, content, offset)

    monkeypatch.setattr(pending_file.os, "pwrite", write)
    with BagWriter(tmp_path / "bag", span_ns=0) as bag:
        writer = WriterThread(bag)
        writer.add_topic("/number", TYPE, ())
        writer.start()
        for index in range(60):
            if index == 20:
                is_full.set()
            if index == 40:
                end = time.monotonic() + 20.0
                while not caplog.records and time.monotonic() < end:
                    time.sleep(0.01)
                is_full.clear()
            writer.put(message(index, size=200_000))
        end = time.monotonic() + 20.0
        while len(caplog.records) < 2 and time.monotonic() < end:
            time.sleep(0.01)
        writer.finish()
        assert writer.error is None
    assert "No space left on device; recording goes on in memory" in caplog.messages[0]
    assert "there is space again" in caplog.messages[1]
    mcap_doctor.examine(tmp_path / "bag" / "bag_0.mcap")
    with BagReader(tmp_path / "bag") as reader:
        assert [m.time_ns for m in reader.messages()] == list(range(60))
