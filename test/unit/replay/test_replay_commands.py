"""process and check as a user meets them: one line for a mistake, and exit codes that a script can use."""

import re
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.node import command_line
from knee_gap_replay import check, process, processing
from knee_gap_replay.whole_bags import one_bag

IMAGE, INFO, POSE = "/knee_gap/image_raw/compressed", "/knee_gap/camera_info", "/knee_gap/scope_body/pose"
PICTURE = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()


def write(path: Path, *, pose_from_ms: int = 0, skip: str = "", picture: bytes = b"") -> Path:
    """Write a second of images at 50 Hz, empty by default, with poses at 100 Hz."""
    with BagWriter(path) as bag:
        for topic, msgtype, period_ms, begin_ms in (
            (IMAGE, "sensor_msgs/msg/CompressedImage", 20, 10),
            (INFO, "sensor_msgs/msg/CameraInfo", 20, 10),
            (POSE, "geometry_msgs/msg/PoseStamped", 10, pose_from_ms),
        ):
            if topic == skip:
                continue
            bag.add_topic(topic, msgtype, "sensor")
            for stamp_ms in range(begin_ms, 1000, period_ms):
                message = blank(msgtype)
                message.header.stamp.nanosec = stamp_ms * 1_000_000
                if topic == IMAGE:
                    message.data = np.frombuffer(picture, np.uint8)
                bag.write(topic, message, (stamp_ms + 5) * 1_000_000)
    return path


def reported(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line on stderr."""
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    return error


SCOPE = "tracking_node:\n  ros__parameters:\n    body_to_shaft_translation: [0.0, 0.0, 0.2]\n"


@pytest.mark.parametrize("workers", ["1", "2"])
def test_process_of_empty_images_says_so_for_each_and_in_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], workers: str
) -> None:
    out = tmp_path / "out"
    bag = write(tmp_path / "bag")
    (bag / "scope.yaml").write_text(SCOPE)
    assert process.main([str(bag), str(out), "--workers", workers]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert "50 /knee_gap/gap_edges" in lines[-2]
    assert lines[-1] == f"process: no image on {IMAGE} could be read: the compressed image is empty: 0 bytes"
    with BagReader(out) as reader:
        statuses = [reader.deserialize(m).status for m in reader.messages(["/knee_gap/gap"])]
        assert reader.topics["/knee_gap/gap/snr"] == "std_msgs/msg/Float64"
        assert not list(reader.messages(["/knee_gap/gap/min"]))
    no_edges = 2
    assert statuses == [no_edges] * 50


def test_process_refuses_mistakes_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = str(write(tmp_path / "bag"))
    poor = str(write(tmp_path / "poor", skip=INFO))
    out = str(tmp_path / "out")
    assert process.main([str(tmp_path / "nothing"), out]) == 1
    assert "does not exist" in reported(capsys)
    (Path(poor) / "scope.yaml").write_text(SCOPE)
    assert process.main([poor, out]) == 1
    assert f"has no topic {INFO}; it has " in reported(capsys)
    assert process.main([bag, out]) == 1
    assert "where the lens sits on the tracked body is not known" in reported(capsys)
    (Path(bag) / "scope.yaml").write_text(SCOPE)
    assert process.main([bag, bag]) == 1
    assert "exists already" in reported(capsys)
    assert process.main([bag, out, "--pose", "/other"]) == 1
    assert "has no topic /other" in reported(capsys)
    parameters = tmp_path / "params.yaml"
    parameters.write_text("tracking_node:\n  ros__parameters:\n    oblique_angel: 0.5\n")
    assert process.main([bag, out, "--params-file", str(parameters)]) == 1
    assert "no parameter oblique_angel of tracking_node" in reported(capsys)
    assert not Path(out).exists()
    with pytest.raises(SystemExit, match="2"):
        process.main([bag])
    assert "required: OUT" in reported(capsys)


def test_process_replaces_its_results_on_demand_and_its_input_never(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = write(tmp_path / "bag"), tmp_path / "out"
    (bag / "scope.yaml").write_text(SCOPE)
    before = (bag / "bag_0.mcap").read_bytes()
    one = ["--workers", "1"]
    assert process.main([str(bag), str(out), *one]) == 1
    written = (out / "out_0.mcap").read_bytes()
    capsys.readouterr()
    assert process.main([str(bag), str(out), *one]) == 1
    assert "exists already" in reported(capsys)
    (out / "out_0.mcap").write_bytes(b"")
    process.main([str(bag), str(out), "--force", *one])
    assert (out / "out_0.mcap").read_bytes() == written
    capsys.readouterr()
    for source in (bag, bag / "bag_0.mcap"):
        assert process.main([str(source), str(bag), "--force", *one]) == 1
        assert "is the bag that is read" in reported(capsys)
    assert (bag / "bag_0.mcap").read_bytes() == before


def test_check_tells_a_usable_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check.main([str(write(tmp_path / "bag", picture=PICTURE))]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2:] == ["complete and undamaged", "usable"]
    assert any(POSE in line and "100.0 Hz" in line and "latency 5.0 ms" in line for line in lines)


@pytest.mark.parametrize(
    ("pose_from_ms", "skip", "reason"),
    [
        (0, POSE, f"not usable: no readable message on {POSE}"),
        (0, IMAGE, f"not usable: no readable message on {IMAGE}"),
        (500, "", "not usable: only 50% of the images have poses within 25 ms before and after them"),
    ],
)
def test_check_tells_why_a_bag_cannot_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pose_from_ms: int, skip: str, reason: str
) -> None:
    assert (
        check.main([str(write(tmp_path / "bag", pose_from_ms=pose_from_ms, skip=skip, picture=PICTURE))]) == 1
    )
    assert capsys.readouterr().out.splitlines()[-1] == reason


def test_check_tells_damage_and_judges_by_what_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = (write(tmp_path / "bag") / "bag_0.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) // 2])
    assert check.main([str(tmp_path / "cut.mcap")]) == 1
    assert "1 damaged or missing parts" in capsys.readouterr().out


def test_check_refuses_what_is_no_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.mcap").write_text("not a bag, but long enough to look at")
    assert check.main([str(tmp_path / "x.mcap")]) == 1
    assert "is not an MCAP file" in reported(capsys)


def test_process_that_is_ended_leaves_a_bag_that_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bag, out = write(tmp_path / "bag"), tmp_path / "out"
    (bag / "scope.yaml").write_text(SCOPE)
    begun = processing.process

    def ended_in_the_middle(reader: BagReader, writer: BagWriter, pipeline: processing.Pipeline) -> None:
        begun(reader, writer, pipeline)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(one_bag, "process", ended_in_the_middle)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert process.main([str(bag), str(out), "--workers", "1"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert reported(capsys) == "process: stopped before the end\n"
    with BagReader(out) as reader:
        assert len(list(reader.messages(["/knee_gap/gap_edges"]))) == 50
        assert not reader.losses


def test_long_work_tells_how_far_it_is_off_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_line, "_SECONDS_BETWEEN_LINES", -1.0)
    assert list(command_line.with_progress(range(4), 4, lambda item: item * 10**15)) == [0, 1, 2, 3]
    lines = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"1 messages \(25 %\), \d+ s left", lines[1])
    assert re.fullmatch(r"3 messages \(75 %\), [\d.e+]+ times real time, \d+ s left", lines[3])
