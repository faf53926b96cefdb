"""A bag is fed by stamps, nothing is dropped, and the same bag gives the same bytes."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mcap_doctor
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank
from knee_gap_core.bag.qos import QosName
from knee_gap_core.node.wiring import Output
from knee_gap_core.values.stamps import set_stamp
from knee_gap_replay.processing import by_stamp, process

POSE = "geometry_msgs/msg/PoseStamped"


def write(path: Path, records: Iterable[tuple[str, int, int]]) -> Path:
    """Write a bag of (topic, stamp, time of recording) [ms]."""
    with BagWriter(path) as bag:
        for topic, stamp_ms, record_ms in records:
            bag.add_topic(topic, POSE)
            message = blank(POSE)
            set_stamp(message.header, stamp_ms * 1_000_000)
            bag.write(topic, message, record_ms * 1_000_000)
    return path


def order(path: Path, topics: list[str]) -> list[tuple[str, int]]:
    with BagReader(path) as reader:
        return [(s.message.topic, s.stamp_ns // 1_000_000) for s in by_stamp(reader, topics)]


class Echo:
    """Publishes what it gets, and a last word."""

    inputs = ("/a", "/b")
    outputs: Mapping[str, tuple[str, QosName]] = MappingProxyType({"/out": (POSE, "reliable")})

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        return [Output("/out", message, stamp_ns)]

    def finish(self) -> Iterable[Output]:
        return [Output("/out", blank(POSE), 0)]


def test_the_order_is_that_of_the_stamps_whatever_the_latencies(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    records = [("/a", t, t + int(rng.integers(0, 300))) for t in range(0, 5000, 16)]
    records += [("/b", t, t + int(rng.integers(0, 20))) for t in range(0, 5000, 8)]
    got = order(write(tmp_path / "bag", sorted(records, key=lambda r: r[2])), ["/a", "/b"])
    assert sorted(got) == sorted((topic, stamp) for topic, stamp, _ in records)
    assert [stamp for _, stamp in got] == sorted(stamp for _, stamp in got)


def test_a_topic_of_another_clock_is_put_where_it_was_recorded(tmp_path: Path) -> None:
    """Stamps since boot beside stamps since 1970, and a first message that is stamped with 0."""
    epoch_ms, boot_ms = 1_790_000_000_000, 5_000_000
    records = [("/a", epoch_ms + t, epoch_ms + t + 4) for t in range(0, 4000, 8)]
    records += [("/b", boot_ms + t if t else 0, epoch_ms + t + 4) for t in range(0, 4000, 16)]
    bag = write(tmp_path / "bag", sorted(records, key=lambda r: r[2]))
    for topics in (["/a", "/b"], ["/b", "/a"]):
        got = order(bag, topics)
        assert sorted(topic for topic, _ in got) == ["/a"] * 500 + ["/b"] * 250
        # Apart from the first, one of /b for every two of /a, at no time more behind than the other.
        names = [topic for topic, _ in got if _ > 0]
        ahead = np.cumsum([1 if name == "/a" else -2 for name in names])
        assert np.abs(ahead).max() <= 4
        stamps = [stamp for _, stamp in got][1:]
        assert stamps == sorted(stamps)


def test_of_equal_stamps_the_first_topic_asked_for_comes_first(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [("/b", 100, 110), ("/a", 100, 130), ("/b", 200, 210), ("/a", 200, 205)])
    assert order(bag, ["/a", "/b"]) == [("/a", 100), ("/b", 100), ("/a", 200), ("/b", 200)]
    assert order(bag, ["/b", "/a"]) == [("/b", 100), ("/a", 100), ("/b", 200), ("/a", 200)]


def test_a_recorded_loop_is_two_passes_one_after_the_other(tmp_path: Path) -> None:
    one = [(topic, t, t + late) for t in range(1000, 9000, 20) for topic, late in (("/a", 9), ("/b", 3))]
    two = [(topic, stamp, record + 8000) for topic, stamp, record in one]
    got = order(write(tmp_path / "bag", sorted([*one, *two], key=lambda r: r[2])), ["/a", "/b"])
    assert len(got) == len(one) + len(two)
    stamps = [stamp for _, stamp in got]
    backwards = [i for i in range(1, len(stamps)) if stamps[i] < stamps[i - 1]]
    # The first pose of the second pass comes before the image of the first pass that was recorded after it.
    assert 1 <= len(backwards) <= 2
    assert sorted(stamps) == sorted(stamp for _, stamp, _ in [*one, *two])


def test_the_same_bag_gives_the_same_bytes_and_drops_nothing(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [(t, k, k) for k in range(0, 3000, 7) for t in ("/a", "/b")])
    written = []
    for name in ("first", "second"):
        out = tmp_path / name
        with BagReader(bag) as reader, BagWriter(out, metadata=reader.metadata) as writer:
            assert process(reader, writer, Echo()) == {"/out": 2 * 429 + 1}
        written.append((out / f"{name}_0.mcap").read_bytes())
    assert written[0] == written[1]


class Delayed:
    """Publishes each message of /b again when two more have come, as a node that waits for others does."""

    inputs = ("/a", "/b")
    outputs: Mapping[str, tuple[str, QosName]] = MappingProxyType({"/out": (POSE, "reliable")})

    def __init__(self) -> None:
        self.waiting: list[Output] = []

    def feed(self, topic: str, message: Any, stamp_ns: int) -> Iterable[Output]:
        output = Output("/out", message, stamp_ns)
        if topic == "/a":
            return [output]
        self.waiting.append(output)
        return [self.waiting.pop(0)] if len(self.waiting) > 2 else []

    def finish(self) -> Iterable[Output]:
        return self.waiting


def test_results_are_logged_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    """In a loop too: the log time then runs on while the stamps begin again."""
    one = [(topic, t, t) for t in range(1000, 4000, 20) for topic in ("/a", "/b")]
    two = [(topic, stamp, record + 3000) for topic, stamp, record in one]
    with BagReader(write(tmp_path / "bag", [*one, *two])) as reader, BagWriter(tmp_path / "out") as writer:
        assert process(reader, writer, Delayed()) == {"/out": 600}
    messages = mcap_doctor.examine(tmp_path / "out" / "out_0.mcap")
    assert len(messages) == 600
    with BagReader(tmp_path / "out") as reader:
        apart = [m.time_ns - (reader.stamp_ns(m) or 0) for m in reader.messages()]
    assert apart[:298] == [0] * 298
    # A step of 2980 ms back in the stamps; the last two of the first pass come after it.
    assert set(apart[298:]) <= {0, 2_980_000_000, 20_000_000, 40_000_000}
    assert apart.count(2_980_000_000) == 300


def test_a_bag_without_a_needed_topic_is_refused(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [("/a", 1, 1)])
    with (
        BagReader(bag) as reader,
        BagWriter(tmp_path / "out") as writer,
        pytest.raises(BagError, match="has no topic /b; it has /a"),
    ):
        process(reader, writer, Echo())


def test_messages_without_stamps_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/a", "std_msgs/msg/Float64")
        bag.write("/a", blank("std_msgs/msg/Float64"), 1)
    with BagReader(tmp_path / "bag") as reader, pytest.raises(BagError, match="without a stamp"):
        list(by_stamp(reader, ["/a"]))


def test_a_message_of_broken_bytes_is_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = write(tmp_path / "bag", [("/a", 1, 1), ("/b", 2, 2)])
    with BagReader(bag) as reader:
        good = next(reader.messages(["/a"]))
    with BagWriter(tmp_path / "broken") as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, POSE)
        writer.write_raw("/a", good.data, 1)
        writer.write_raw("/a", good.data[:21], 2)
        writer.write_raw("/b", good.data, 3)
    with BagReader(tmp_path / "broken") as reader, BagWriter(tmp_path / "out") as writer:
        assert process(reader, writer, Echo()) == {"/out": 3}
    assert len(caplog.records) == 1
    assert "on /a cannot be read" in caplog.text
