"""check on bags that are damaged, replayed or foreign: what it saves, and what it reports."""

import logging
from pathlib import Path

import mcap_doctor
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from ros_bags import MADE_BAGS

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.stamps import set_stamp
from knee_gap_replay import check, process

POSE = "geometry_msgs/msg/PoseStamped"
MS, YEAR_NS = 1_000_000, 31_536_000 * 10**9


def write(path: Path, count: int = 300, compression: str = "none") -> Path:
    rng = np.random.default_rng(6)
    with BagWriter(path, metadata={"take": "7"}, compression=compression) as bag:  # type: ignore[arg-type]
        bag.add_topic("/pose", POSE, "sensor")
        for index in range(count):
            message = blank(POSE)
            set_stamp(message.header, index * 10 * MS)
            message.pose.position.x = rng.standard_normal()
            bag.write("/pose", message, index * 10 * MS + 4 * MS)
    return path


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_recovery_saves_every_complete_message_of_a_cut_file(tmp_path: Path, compression: str) -> None:
    bag = write(tmp_path / "bag", compression=compression)
    content = (bag / "bag_0.mcap").read_bytes()
    with BagReader(bag) as reader:
        original = [(m.time_ns, m.data) for m in reader.messages()]
    saved_counts = []
    for tenth in range(1, 10):
        cut = tmp_path / f"cut_{tenth}.mcap"
        cut.write_bytes(content[: len(content) * tenth // 10])
        out = tmp_path / f"saved_{tenth}"
        code = check.main([str(cut), "--recover", str(out)])
        if code != 0:  # not one block of the first chunk
            assert compression != "none"
            assert tenth < 4
            continue
        mcap_doctor.examine(out / f"saved_{tenth}_0.mcap")
        with BagReader(out) as reader:
            saved = [(m.time_ns, m.data) for m in reader.messages()]
            assert reader.metadata == {"take": "7"}
        assert saved == original[: len(saved)]
        saved_counts.append(len(saved))
        if compression == "none":
            whole = [data for _, data in original if data in cut.read_bytes()]
            assert len(saved) == len(whole)
    assert saved_counts == sorted(saved_counts)
    # The index takes a share of the file too.
    assert saved_counts[-1] >= 200


def test_recovery_keeps_foreign_types_as_they_are(tmp_path: Path) -> None:
    for name in ("with_service_events", "rewritten", "former_type_name", "without_index", "wrong_rmw_test"):
        bag = MADE_BAGS[name].write(tmp_path / name)
        out = tmp_path / f"saved_{name}"
        assert check.main([str(bag), "--recover", str(out)]) == 0
        with BagReader(bag) as first, BagReader(out) as second:
            assert [m[2:] for m in first.messages()] == [m[2:] for m in second.messages()]
            for topic, details in first.details.items():
                assert second.details[topic] == details


def test_nothing_to_recover_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag"):
        pass
    assert check.main([str(tmp_path / "bag"), "--recover", str(tmp_path / "out")]) == 1
    assert "holds no message that can be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_latency_in_a_replay_is_by_the_clock_of_the_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Played three years later at half the rate, images arrived after 2 ms and answers after 11."""
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("/image", "/answer"):
            bag.add_topic(topic, POSE)
        for index in range(100):
            stamp_ns = index * 16 * MS
            message = blank(POSE)
            set_stamp(message.header, stamp_ns)
            for topic, late_ms in (("/image", 2), ("/answer", 11)):
                bag.write(topic, message, 3 * YEAR_NS + 2 * stamp_ns + late_ms * MS)
        # As a node reports silence, before the first image and after the last: by its own clock.
        for now_ns in (3 * YEAR_NS - 50 * MS, 3 * YEAR_NS + 4_000 * MS):
            set_stamp(message.header, now_ns)
            bag.write("/answer", message, now_ns)
    check.main([str(tmp_path / "bag")])
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    for topic, latency_ms in (("/image", "0.0"), ("/answer", "9.0")):
        assert "recorded 1095.0 days after it was stamped" in lines[topic]
        assert "replayed at 0.5 times its rate" in lines[topic]
        assert f"latency above the least {latency_ms} ms, at most {latency_ms} ms" in lines[topic]
    assert "2 stamped by another clock" in lines["/answer"]


def test_two_messages_of_two_clocks_are_no_obstacle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/answer", POSE)
        for stamp_ns in (3 * YEAR_NS, 16 * MS):
            message = blank(POSE)
            set_stamp(message.header, stamp_ns)
            bag.write("/answer", message, 3 * YEAR_NS + MS)
    check.main([str(tmp_path / "bag")])
    assert "1 stamped by another clock" in capsys.readouterr().out


def test_images_that_cannot_be_read_are_not_usable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = "/knee_gap"
    with BagWriter(tmp_path / "bag") as bag:
        for topic, msgtype in (
            ("image_raw", "sensor_msgs/msg/Image"),
            ("camera_info", "sensor_msgs/msg/CameraInfo"),
            ("scope_body/pose", POSE),
        ):
            bag.add_topic(f"{space}/{topic}", msgtype)
            for index in range(50):
                message = blank(msgtype)
                set_stamp(message.header, index * 10 * MS)
                if topic == "image_raw":
                    message.encoding, message.height, message.width, message.step = "32FC1", 2, 2, 8
                    message.data = np.zeros(16, np.uint8)
                bag.write(f"{space}/{topic}", message, index * 10 * MS)
    assert check.main([str(tmp_path / "bag")]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith(f"not usable: no image on {space}/image_raw could be read: ")
    assert "32FC1" in last


def test_foreign_channels_and_empty_messages_are_told_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("", "somebody")
        for topic, name, encoding, schema, serialization in (
            ("/json", "Thing", "jsonschema", b"{}", "json"),
            ("/proto", "a.Thing", "protobuf", b"\x0a\xff\x00\x01", "protobuf"),
            ("/none", "", "", b"", "cbor"),
            ("/empty", "std_msgs/msg/Empty", "ros2msg", b"", "cdr"),
            ("/test_empty", "test_msgs/msg/Empty", "ros2msg", b"", "cdr"),
        ):
            known = writer.register_schema(name, encoding, schema) if name else 0
            channel = writer.register_channel(topic, serialization, known)
            writer.add_message(channel, 1, bytes([0, 1, 0, 0]), 1)
        writer.finish()  # type: ignore[no-untyped-call]
    with caplog.at_level(logging.WARNING):
        assert check.main([str(path)]) == 1
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    for topic in ("/json", "/proto", "/none"):
        assert "unreadable" in lines[topic]
    for topic in ("/empty", "/test_empty"):
        assert "unreadable" not in lines[topic]
    assert check.main([str(path), "--recover", str(tmp_path / "out")]) == 0
    with BagReader(path) as first, BagReader(tmp_path / "out") as second:
        assert sorted(first.messages()) == sorted(second.messages())
        assert first.details["/proto"].definition_bytes == second.details["/proto"].definition_bytes


def test_of_two_cameras_in_a_bag_the_choice_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for side in ("left", "right"):
            bag.add_topic(f"/{side}/image", "sensor_msgs/msg/Image")
        bag.add_topic("/rigid/pose", POSE)
        bag.write("/rigid/pose", blank(POSE), 1)
    hint = "choose with --image /left/image or /right/image, --pose /rigid/pose"
    assert check.main([str(tmp_path / "bag")]) == 1
    assert capsys.readouterr().out.splitlines()[-1].endswith(hint)
    assert process.main([str(tmp_path / "bag"), str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.strip().endswith(hint)
    assert not (tmp_path / "out").exists()
