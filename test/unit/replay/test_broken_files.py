"""Files of every kind, cut and damaged at seeded places: no traceback, one line, and a bounded time.

A command ends with 0 where it could use what is left, else not; anything that it raises fails the test.
"""

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank
from knee_gap_perception.calibrate import command as calibrate
from knee_gap_perception.calibration.calibration import Calibration, Clock, LensOnBody, Tip
from knee_gap_perception.calibration.calibration_file import load_calibration, save_calibration
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount
from knee_gap_perception.tracker_precision import command as tracker_precision_command
from knee_gap_perception.trackers.motive_csv import read_take
from knee_gap_replay import check, import_motive, process

IMAGE, INFO, POSE = "/knee_gap/image_raw/compressed", "/knee_gap/camera_info", "/knee_gap/scope_body/pose"
SCOPE = (
    "/**/tracking_node:\n  ros__parameters:\n    body_to_shaft_translation: [0.0, 0.0, 0.2]\n"
    "    body_to_shaft_quaternion_xyzw: [0.0, 0.0, 0.0, 1.0]\n    translation_error: 1.0e-4\n"
)
PICTURE = cv2.imencode(".jpg", np.full((64, 64, 3), 90, np.uint8))[1].tobytes()
CUTS, FLIPS = 12, 24
# Of one run on a machine that is busy otherwise [s of this process].
MOST_SECONDS = 20.0

Run = Callable[[Path], int]


def write_bag(path: Path) -> Path:
    """Small grey images at 50 Hz and poses at 100 Hz, in several chunks, and parameters."""
    with BagWriter(path, metadata={"take": "none"}) as bag:
        for topic, msgtype in (
            (IMAGE, "sensor_msgs/msg/CompressedImage"),
            (INFO, "sensor_msgs/msg/CameraInfo"),
            (POSE, "geometry_msgs/msg/PoseStamped"),
        ):
            bag.add_topic(topic, msgtype, "sensor")
        for stamp_ms in range(0, 400, 10):
            for topic, msgtype in ((POSE, "PoseStamped"), (IMAGE, "CompressedImage"), (INFO, "CameraInfo")):
                if topic != POSE and stamp_ms % 20:
                    continue
                package = "geometry_msgs" if topic == POSE else "sensor_msgs"
                message = blank(f"{package}/msg/{msgtype}")
                message.header.stamp.nanosec = stamp_ms * 1_000_000
                if topic == POSE:
                    message.pose.position.x = 1e-3 * np.sin(stamp_ms)
                if topic == IMAGE:
                    message.format, message.data = "jpeg", np.frombuffer(PICTURE, np.uint8)
                bag.write(topic, message, (stamp_ms + 5) * 1_000_000)
            if stamp_ms % 100 == 90:
                bag.flush()
    (path / "scope.yaml").write_text(SCOPE)
    return path


def write_take(path: Path) -> Path:
    """A take of one body over 30 frames, as Motive exports it."""
    lines = [
        'Format Version,1.23,Take Name,"a, take",Export Frame Rate,100.0,'
        "Capture Start Time,2021-04-18 02.24.27.730 PM,Total Exported Frames,30,"
        "Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global",
        "",
        ",Type" + ",Rigid Body" * 8,
        ",Name" + ',"scope"' * 8,
        ",ID" + ",1" * 8,
        ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,",
        *(f"{n},{n / 100:.6f},0.0,0.0,0.0,1.0,{n / 1000:.6f},0.2,0.3,0.0004" for n in range(30)),
    ]
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def write_calibration(path: Path) -> Path:
    """A calibration of the lens, the tip and the clock."""
    lens = LensOnBody(
        np.array([0.0, 0.0, 0.2]),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.diag(np.full(6, 1e-8)),
        Mount.CAMERA_HEAD,
        1e-4,
        1e-4,
        0.4,
        40,
    )
    tip = Tip(np.array([0.0, 0.0, 0.2]), np.diag(np.full(3, 1e-10)), 1e-5)
    save_calibration(Calibration(1280, 720, None, lens, None, tip, Clock(-0.012, 1e-4, "board")), path)
    return path


def damaged(content: bytes, seed: int) -> Iterator[tuple[str, bytes]]:
    """The content cut, flipped, with parts doubled, lost, and replaced by other bytes, at seeded places."""
    rng = np.random.default_rng(seed)
    for place in sorted({0, 1, len(content) - 1, *rng.integers(0, len(content), CUTS).tolist()}):
        yield f"cut at {place}", content[:place]
    for place in rng.integers(0, len(content), FLIPS).tolist():
        flipped = bytearray(content)
        flipped[place] ^= int(rng.integers(1, 256))
        yield f"flipped at {place}", bytes(flipped)
    for place in rng.integers(0, len(content), CUTS).tolist():
        length = int(rng.integers(1, 64))
        part = content[place : place + length]
        yield f"doubled {length} at {place}", content[:place] + part + content[place:]
        yield f"lost {length} at {place}", content[:place] + content[place + length :]
        other = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        yield f"other {length} at {place}", content[:place] + other + content[place + length :]
    for pieces in (
        b'"',
        b"[[[[",
        b"\x00",
        b"{",
        b"&a ",
        b"*a",
        b"\xff\xfe",
        b"- - ",
        b"9" * 400,
        b"\n",
        b"nan",
    ):
        place = int(rng.integers(0, len(content)))
        yield f"{pieces[:4]!r} at {place}", content[:place] + pieces + content[place:]


def judge(run: Run, place: Path, what: str, capsys: pytest.CaptureFixture[str]) -> int:
    """Run a command; it ends with a code, has one line for a mistake, and takes a bounded time."""
    begin = time.process_time()
    try:
        code = run(place)
    except SystemExit as end:
        code = int(end.code or 0)
    took = time.process_time() - begin
    printed = capsys.readouterr()
    assert took < MOST_SECONDS, f"{what}: {took:.1f} s"
    assert "Traceback" not in printed.err, what
    if code:
        said = (printed.err or printed.out).strip().splitlines()
        errors = [line for line in printed.err.splitlines() if "%" not in line]  # but progress
        assert said, f"{what}: nothing was said"
        answered = "not usable" in printed.out or "could be read: " in printed.out
        assert answered or len(errors) == 1, f"{what}: {printed.err}"
    return code


@pytest.fixture
def fresh_bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag")


def codes(
    files: Iterator[tuple[str, bytes]], place: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> list[int]:
    found = []
    for what, content in files:
        place.write_bytes(content)
        found.append(judge(run, place, what, capsys))
    return found


def read_all(path: Path) -> tuple[int, str]:
    """The number of messages of a bag, or why it is refused."""
    try:
        with BagReader(path) as reader:
            return sum(1 for _ in reader.messages()), ""
    except BagError as error:
        return 0, str(error)


def test_a_broken_bag_is_checked(fresh_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = fresh_bag / "bag_0.mcap"
    files = damaged(file.read_bytes(), 11)
    found = codes(files, file, lambda _: check.main([str(fresh_bag)]), capsys)
    assert set(found) == {0, 1}


def test_a_broken_bag_is_processed(fresh_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = fresh_bag / "bag_0.mcap", fresh_bag.parent / "out"

    def run(_: Path) -> int:
        shutil.rmtree(out, ignore_errors=True)
        return process.main([str(fresh_bag), str(out)])

    found = codes(
        (one for n, one in enumerate(damaged(file.read_bytes(), 12)) if n % 4 == 0), file, run, capsys
    )
    assert set(found) == {0, 1}


def test_a_broken_bag_is_calibrated_and_judged(fresh_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, into = fresh_bag / "bag_0.mcap", fresh_bag.parent / "into.yaml"
    for step in ("pivot", "time_offset"):
        codes(
            damaged(file.read_bytes(), 13),
            file,
            lambda _, step=step: calibrate.main([step, str(fresh_bag), "--into", str(into)]),  # type: ignore[misc]
            capsys,
        )
    out = fresh_bag.parent / "precision"
    codes(
        (one for number, one in enumerate(damaged(file.read_bytes(), 14)) if number % 8 == 0),
        file,
        lambda _: tracker_precision_command.main([str(fresh_bag), "--out", str(out)]),
        capsys,
    )


def test_broken_metadata_hide_no_message(fresh_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = fresh_bag / "metadata.yaml"
    for what, content in damaged(file.read_bytes(), 15):
        file.write_bytes(content)
        count, flaw = read_all(fresh_bag)
        # One that names another storage, or compressed files, is believed.
        assert count == 80 or "convert it first" in flaw, f"{what}: {count} messages, {flaw}"


def test_broken_parameters_are_refused_or_mean_what_they_say(
    fresh_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = fresh_bag / "scope.yaml", fresh_bag.parent / "out"

    def run(_: Path) -> int:
        shutil.rmtree(out, ignore_errors=True)
        return process.main([str(fresh_bag), str(out)])

    found = codes((one for n, one in enumerate(damaged(SCOPE.encode(), 16)) if n % 2 == 0), file, run, capsys)
    assert set(found) == {0, 1}


def test_a_broken_calibration_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_calibration(tmp_path / "scope.yaml")
    whole = file.read_bytes()
    files = [one for one in damaged(whole, 17) if one[1] != whole]
    found = codes(iter(files), file, lambda path: calibrate.main(["show", str(path)]), capsys)
    # Only what YAML does not care about, such as a space, leaves it as it was.
    assert found.count(0) < len(found) / 8


def test_a_broken_take_is_refused_or_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = write_take(tmp_path / "take.csv"), tmp_path / "out"

    def run(path: Path, *more: str) -> int:
        shutil.rmtree(out, ignore_errors=True)
        return import_motive.main([str(path), "scope", str(out), *more])

    assert run(file) == 0
    capsys.readouterr()
    for more in ((), ("--partial",)):
        found = codes(
            damaged(write_take(file).read_bytes(), 18),
            file,
            lambda path, more=more: run(path, *more),  # type: ignore[misc]
            capsys,
        )
        assert set(found) == {0, 1}


def test_no_reader_lets_anything_but_its_own_error_out(tmp_path: Path) -> None:
    """Bytes of no format at all, under every name."""
    rng = np.random.default_rng(19)
    for number in range(60):
        data = rng.integers(0, 256, int(rng.integers(0, 2000)), dtype=np.uint8).tobytes()
        magic = (b"", b"\x89MCAP0\r\n\x01", b"\x89MCAP0\r\n", b"Format Version,1.23,", b"format: ")[
            number % 5
        ]
        path = tmp_path / "junk"
        path.write_bytes(magic + data + (b"\x89MCAP0\r\n" if number % 2 else b""))
        assert read_all(path)[0] == 0
        for read in (read_take, load_calibration):
            with pytest.raises(PerceptionError):
                read(path)
