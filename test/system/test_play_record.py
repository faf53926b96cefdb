"""play and record as processes: what a bag holds is what arrives, and what arrives is what is kept."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mcap_doctor
import numpy as np
import pytest

pytest.importorskip("rclpy")

from live import Client
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.stamps import set_stamp

DOMAIN = 61
IMAGE, INFO, POSE = "/image", "/info", "/pose"
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]


def write(path: Path, *, seconds: float, raw: bool = False) -> Path:
    """Write a bag of images at 60 Hz, poses at 120 Hz and one camera model kept for late subscribers."""
    rng = np.random.default_rng(11)
    msgtype = "sensor_msgs/msg/Image" if raw else "sensor_msgs/msg/CompressedImage"
    size = 1280 * 720 * 3 if raw else 150_000
    with BagWriter(path) as bag:
        bag.add_topic(INFO, "sensor_msgs/msg/CameraInfo", "latched")
        bag.add_topic(IMAGE, msgtype, "sensor")
        bag.add_topic(POSE, "geometry_msgs/msg/PoseStamped", "sensor")
        info = blank("sensor_msgs/msg/CameraInfo")
        info.width = 1280
        bag.write(INFO, info, 0)
        image = blank(msgtype)
        image.data = rng.integers(0, 256, size, dtype=np.uint8)
        for index in range(round(seconds * 120)):
            stamp_ns = index * 1_000_000_000 // 120
            pose = blank("geometry_msgs/msg/PoseStamped")
            for message in (image, pose):
                set_stamp(message.header, stamp_ns)
            bag.write(POSE, pose, stamp_ns)
            if index % 2 == 0:
                image.data[:8] = rng.integers(0, 256, 8, dtype=np.uint8)
                bag.write(IMAGE, image, stamp_ns)
    return path


def contents(path: Path) -> dict[str, list[bytes]]:
    """Return the bytes of every message, by topic."""
    with BagReader(path) as reader:
        messages = list(reader.messages())
        return {topic: [m.data for m in messages if m.topic == topic] for topic in reader.topics}


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with Processes(tmp_path, ENVIRONMENT) as started:
        yield started


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("played") / "bag", seconds=2.0)


def record(processes: Processes, out: Path, *topics: str) -> None:
    processes.start("record", [executable("knee_gap_replay", "record"), str(out), *topics])


def play(processes: Processes, bag: Path, *options: str) -> None:
    processes.start("play", [executable("knee_gap_replay", "play"), str(bag), *options])


def signalled(processes: Processes, name: str, number: int) -> int:
    """Send a signal to a process and return its exit code."""
    process = processes._running[name]
    process.send_signal(number)
    return processes.wait(name)


def wait_said(processes: Processes, name: str, words: str) -> None:
    """Wait until a process has said something; fails after half a minute."""
    end = time.monotonic() + 30.0
    while words not in processes.log(name).read_text():
        assert time.monotonic() < end, f"{name} never said {words}"
        time.sleep(0.05)


def test_what_was_played_is_recorded_byte_for_byte(bag: Path, tmp_path: Path, processes: Processes) -> None:
    record(processes, tmp_path / "out", IMAGE, INFO, POSE)
    play(processes, bag, "--wait-for", IMAGE, INFO, POSE)
    assert processes.wait("play") == 0, processes.last_words("play")
    assert processes.end("record") == 0, processes.last_words("record")
    assert contents(tmp_path / "out") == contents(bag)
    assert processes.last_words("play").startswith("play: 361 messages of 3 topics in 2.")
    with BagReader(tmp_path / "out") as reader, BagReader(bag) as played:
        assert reader.topics == played.topics
        times = [message.time_ns for message in reader.messages([IMAGE])]
    # The pace is that of the recording: 119 periods of a sixtieth.
    assert (times[-1] - times[0]) * 1e-9 == pytest.approx(119 / 60, abs=0.1)
    assert (tmp_path / "out" / "metadata.yaml").exists()


def test_raw_images_at_full_rate_lose_nothing(tmp_path: Path, processes: Processes) -> None:
    played = write(tmp_path / "raw", seconds=2.0, raw=True)
    record(processes, tmp_path / "out", IMAGE, POSE)
    play(processes, played, "--topics", IMAGE, POSE, "--wait-for", IMAGE, POSE)
    assert processes.wait("play") == 0, processes.last_words("play")
    assert processes.end("record") == 0, processes.last_words("record")
    expected = contents(played)
    assert contents(tmp_path / "out") == {topic: expected[topic] for topic in (IMAGE, POSE)}


def test_a_killed_recorder_leaves_all_but_the_last_moment(
    bag: Path, tmp_path: Path, processes: Processes
) -> None:
    out = tmp_path / "out"
    record(processes, out, IMAGE, POSE)
    play(processes, bag, "--topics", IMAGE, POSE, "--wait-for", IMAGE, POSE)
    assert processes.wait("play") == 0, processes.last_words("play")
    time.sleep(1.2)
    signalled(processes, "record", signal.SIGKILL)
    assert not (out / "metadata.yaml").exists()
    with BagReader(out) as reader:
        kept = {topic: [m.data for m in reader.messages([topic])] for topic in (IMAGE, POSE)}
        assert reader.losses
    expected = contents(bag)
    for topic in (IMAGE, POSE):
        assert kept[topic] == expected[topic][: len(kept[topic])]
    # All of the images, whose chunks are full; of the poses at least what the regular flushing wrote.
    assert len(kept[IMAGE]) >= 60
    assert len(kept[POSE]) >= 120


def test_a_late_recorder_still_gets_what_is_kept_for_it_and_names_what_never_came(
    bag: Path, tmp_path: Path, processes: Processes
) -> None:
    play(processes, bag, "--loop")
    time.sleep(3.0)
    record(processes, tmp_path / "out", INFO, "/nobody")
    wait_said(processes, "record", f"record: {INFO}")
    time.sleep(0.5)
    assert signalled(processes, "record", signal.SIGTERM) == 0
    assert signalled(processes, "play", signal.SIGTERM) == 0
    assert "no message was received on /nobody" in processes.log("record").read_text()
    with BagReader(tmp_path / "out") as reader:
        assert list(reader.topics) == [INFO]
        assert len(list(reader.messages())) >= 1


def test_a_loop_begins_again_with_the_stamps_and_clock_of_the_bag(bag: Path, processes: Processes) -> None:
    with Client(DOMAIN, namespace="") as client:
        client.listen(Clock, "/clock")
        client.listen(CameraInfo, INFO)
        play(processes, bag, "--loop", "--clock", "--rate", "4", "--wait-for", INFO)
        client.spin_until(lambda: len(client.received[INFO]) >= 4, timeout=40.0)
        assert signalled(processes, "play", signal.SIGINT) == 0
        ticks = [message.clock.sec * 10**9 + message.clock.nanosec for message in client.received["/clock"]]
    steps = np.diff(ticks)
    assert np.count_nonzero(steps < 0) >= 2
    assert np.median(steps) == 10_000_000
    assert max(ticks) < 2_000_000_000


def test_a_part_under_another_name_is_recorded_in_split_and_packed_files(
    bag: Path, tmp_path: Path, processes: Processes
) -> None:
    out = tmp_path / "out"
    command = [executable("knee_gap_replay", "record"), str(out), "--all", "--compression", "zstd"]
    processes.start("record", [*command, "--max-bag-duration", "0.4"])
    part = ["--start-offset", "0.5", "--playback-duration", "1", "--remap", f"{POSE}:=/other/pose"]
    # Discovered while it waits: no topic is asked for by name.
    play(processes, bag, *part, "--delay", "3", "--topics", POSE, INFO)
    assert processes.wait("play") == 0, processes.last_words("play")
    assert processes.end("record") == 0, processes.last_words("record")
    kept, expected = contents(out), contents(bag)
    assert kept["/other/pose"] == expected[POSE][60:180]
    assert kept[INFO] == expected[INFO]
    assert "121 messages of 2 topics" in processes.last_words("play")
    files = sorted(out.glob("*.mcap"))
    assert [file.name for file in files] == [f"out_{index}.mcap" for index in range(len(files))]
    assert len(files) >= 3
    for file in files:
        mcap_doctor.examine(file)


@pytest.mark.parametrize(
    ("name", "arguments", "reason"),
    [
        ("play", ["{none}"], "does not exist"),
        ("play", ["{bag}", "--rate", "0"], "must be greater than 0"),
        ("play", ["{bag}", "--rate", "-2"], "--rate"),
        ("play", ["{bag}", "--rate", "fast"], "'fast' is not a number"),
        ("play", ["{bag}", "--topics", "/gap"], "has no topic /gap; it has /image, /info, /pose"),
        ("play", ["{bag}", "--backwards"], "unrecognized arguments: --backwards"),
        ("play", ["{bag}", "--wait-for", "/pose", "--wait-timeout", "0.3"], "no subscriber to /pose"),
        ("play", ["{bag}", "--ros-args", "-p", "speed:=2"], "no parameter speed"),
        ("play", ["{bag}", "--ros-args", "--nonsense"], "--nonsense"),
        ("play", ["{bag}", "--remap", "/gap:=/other"], "has no topic /gap"),
        ("play", ["{bag}", "--remap", "/pose"], "takes FROM:=TO"),
        ("record", ["{bag}", "/pose"], "exists already"),
        ("record", ["{none}", "/pose", "--max-bag-size", "12"], "at least 1000000 bytes"),
        ("record", ["{none}", "/pose", "--compression", "rar"], "--compression"),
        ("record", ["{none}"], "required: TOPIC"),
        ("record", ["{none}", "/pose", "--duration", "-1"], "--duration"),
        ("record", ["{none}", "not a topic"], "not a topic"),
    ],
)
def test_a_mistake_is_told_in_one_line(
    bag: Path, tmp_path: Path, name: str, arguments: list[str], reason: str
) -> None:
    none = tmp_path / "none"
    filled = [argument.format(bag=bag, none=none) for argument in arguments]
    result: Any = subprocess.run(
        [executable("knee_gap_replay", name), *filled],
        env={**os.environ, **ENVIRONMENT},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert result.returncode not in (0, 130), result
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.startswith(f"{name}: ")
    assert not none.exists()
