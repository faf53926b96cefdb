"""`calibrate` on a small simulated bag: the whole way from pictures to a file, and a user's mistakes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse, to_vector
from knee_gap_perception.calibrate.bag_input import STEP_TOPIC, CalibrationBag
from knee_gap_perception.calibrate.command import chosen_steps, main
from knee_gap_perception.calibrate.recording import Recording, Request
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_perception.camera.medium import SALINE
from knee_gap_perception.errors import PerceptionError
from knee_gap_simulation.calibration.bag import CalibrationRecording, calibration_truth, make_calibration_bag

BOARD = "charuco:12x9:3:2"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "bag"
    make_calibration_bag(path, CalibrationRecording(seed=31, fps=5, board_s=8, oblique_s=0, pivot_s=6))
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, list[str]]:
    code = main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return code, printed.out, [line for line in printed.err.splitlines() if "%" not in line]


def test_a_bag_becomes_a_calibration(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scope.yaml"
    for step, extra in (("intrinsics", ["--board", BOARD]), ("hand_eye", ["--board", BOARD]), ("pivot", [])):
        code, _, errors = run(capsys, step, bag, "--into", out, "--views", 16, *extra)
        assert (code, errors) == (0, [])
    found = load_calibration(out)
    with BagReader(bag) as reader:
        truth = json.loads(reader.metadata["knee_gap_calibration_truth"])
    assert found.camera is not None
    assert found.lens is not None
    assert found.tip is not None
    assert found.clock is not None
    assert found.camera.parameters[0] == pytest.approx(truth["lens"]["focal_px"], abs=0.5)
    quaternion, translation = (
        np.array(truth["T_body_lens"][key]) for key in ("quaternion_xyzw", "translation")
    )
    angle = 2 * np.arccos(quaternion[3])
    true_lens = from_rotation_vectors(quaternion[:3] / np.linalg.norm(quaternion[:3]) * angle, translation)
    error = to_vector(inverse(found.body_to_lens()) @ true_lens)
    assert np.linalg.norm(error[3:]) < 0.2e-3
    assert np.linalg.norm(error[:3]) < np.radians(0.2)
    assert error @ np.linalg.solve(found.lens.covariance, error) < 22.5  # 99.9 % of 6 degrees of freedom
    assert abs(found.clock.offset - truth["time_offset"]) < 1e-3
    assert np.linalg.norm(found.tip.position - truth["tip"]) < 0.1e-3
    # The scope was never turned: a turn of it is refused rather than guessed.
    with pytest.raises(PerceptionError, match="axis is not calibrated"):
        found.body_to_lens(0.2)
    code, text, _ = run(capsys, "show", out)
    assert code == 0
    assert found.hash in text


def test_steps_of_a_bag(bag: Path) -> None:
    steps = CalibrationBag(bag).steps()
    assert list(steps) == ["board", "pivot"]
    stamps = CalibrationBag(bag).part("board").image_stamps("/knee_gap/image_raw/compressed")
    assert len(stamps) == 40


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["intrinsics", "BAG", "--into", "OUT"], "Name it with --board"),
        (["intrinsics", "BAG", "--into", "OUT", "--board", "chess"], "a board is charuco"),
        (
            ["intrinsics", "BAG", "--into", "OUT", "--board", "dots:4x11:2", "--views", "6"],
            "found in none of",
        ),
        (["intrinsics", "BAG", "--into", "OUT", "--board", BOARD, "--views", "2"], "--views"),
        (
            ["intrinsics", "BAG", "--into", "OUT", "--board", BOARD, "--image-topic", "/camera"],
            "topics of that kind",
        ),
        (["time_offset", "BAG", "--into", "OUT", "--pose-topic", "/nowhere"], "/knee_gap/scope_body/pose"),
        (["oblique", "BAG", "--into", "OUT", "--board", BOARD, "--end", "2"], "about a second"),
        (["pivot", "BAG", "--into", "OUT"], "calibrate intrinsics first"),
        (["intrinsics", "BAG", "--into", "OUT", "--board", BOARD, "--begin", "500"], "from 500 s"),
        (["hand_eye", "BAG", "--into", "OUT", "--board", BOARD, "--begin", "5", "--end", "2"], "lie before"),
        (["pivot", "BAG", "--into", "OUT", "--begin", "1e300"], "lie before"),
        (["pivot", "BAG", "--into", "OUT", "--time-offset", "1e300"], "--time-offset must lie within 10 s"),
        (["time_offset", "BAG", "--into", "NOWHERE/scope.yaml"], "in a writable folder"),
        (["hand_eye", "NOWHERE", "--into", "OUT", "--board", BOARD], "does not exist"),
        (["show", "OUT"], "cannot be read"),
        (
            ["intrinsics", "BAG", "--into", "OUT", "--board", BOARD, "--medium", "beer"],
            "--medium must be air",
        ),
    ],
)
def test_mistakes_are_one_line(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    places = {"BAG": str(bag), "OUT": str(tmp_path / "scope.yaml"), "NOWHERE": str(tmp_path / "nowhere")}
    given = [argument.replace("NOWHERE", places["NOWHERE"]) for argument in arguments]
    code, _, errors = run(capsys, *(places.get(argument, argument) for argument in given))
    assert code == 1
    assert len(errors) == 1
    assert reason in errors[0]
    assert not (tmp_path / "scope.yaml").exists()


def copied(bag: Path, out: Path, keep: Callable[[BagMessage], bool]) -> Path:
    """A bag of some of the messages of another, byte for byte."""
    with BagReader(bag) as reader, BagWriter(out) as writer:
        for name, topic in reader.details.items():
            writer.add_topic(name, topic.msgtype, topic.qos)
        for message in reader.messages():
            if keep(message):
                writer.write_raw(message.topic, message.data, message.time_ns)
    return out


def start_of(bag: Path, step: str) -> int:
    """When a step of a marked bag begins [ns]."""
    with BagReader(bag) as reader:
        first = next(reader.messages()).time_ns
    return first + round(CalibrationBag(bag).steps()[step][0] * 1e9)


@pytest.fixture(scope="module")
def step_bags(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The board and the pivoting of a bag, each in a bag without marks."""
    folder = tmp_path_factory.mktemp("steps")
    end_ns = start_of(bag, "pivot")
    board = copied(bag, folder / "board", lambda m: m.topic != STEP_TOPIC and m.time_ns < end_ns)
    pivot = copied(bag, folder / "pivot", lambda m: m.topic != STEP_TOPIC and m.time_ns >= end_ns)
    return board, pivot


def test_a_bag_a_step_gives_what_one_marked_bag_gives(
    bag: Path, step_bags: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board, pivot = step_bags
    options = ["--board", BOARD, "--views", 12]
    one, two, three = tmp_path / "one.yaml", tmp_path / "two.yaml", tmp_path / "three.yaml"
    named = [f"board={board}", f"pivot={pivot}"]
    for step, of in (("intrinsics", board), ("hand_eye", board), ("pivot", pivot)):
        for out, bags in ((one, [bag]), (two, named), (three, [of])):
            code, _, errors = run(capsys, step, *bags, "--into", out, *options)
            assert (code, errors) == (0, [])
    marked, together, single = (load_calibration(path) for path in (one, two, three))
    for found in (together, single):
        assert found.camera is not None
        assert marked.camera is not None
        assert found.tip is not None
        assert marked.tip is not None
        assert found.camera.parameters == pytest.approx(marked.camera.parameters, abs=1e-6)
        assert found.tip.position == pytest.approx(marked.tip.position, abs=5e-6)
        # The body's path is smoothed up to the end of its bag.
        error = to_vector(inverse(found.body_to_lens()) @ marked.body_to_lens())
        assert np.linalg.norm(error[3:]) < 2e-5
        assert np.linalg.norm(error[:3]) < 2e-5


def test_all_steps_are_those_that_bags_are_named_for(step_bags: tuple[Path, Path]) -> None:
    board, pivot = step_bags
    steps = ["time_offset", "intrinsics", "hand_eye"]
    for bags, known in (({"board": board, "pivot": pivot}, [*steps, "pivot"]), ({"": board}, steps)):
        assert chosen_steps("all", Recording(Request(bags), lambda items, _: items)) == known


@pytest.mark.parametrize(
    ("bags", "reason"),
    [
        (["BOARD", "PIVOT"], "of several bags each is one step: name them board=BAG"),
        (["board=BOARD", "PIVOT"], "which step is it?"),
        (["board=BOARD", "board=PIVOT"], "two bags are named for the step board"),
        (["pivot=PIVOT"], "no bag is named for the step 'board'; there are pivot"),
        (["board=BOARD", "pivot=BAG"], "overlap in time"),
        (["board=BOARD", "pivot=PIVOT", "--end", "3"], "several bags are given"),
        (["board=NOWHERE"], "does not exist"),
        (["bored=BOARD"], "does not exist"),
    ],
)
def test_mistakes_with_several_bags_are_one_line(
    bag: Path,
    step_bags: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    bags: list[str],
    reason: str,
) -> None:
    places = {"BOARD": step_bags[0], "PIVOT": step_bags[1], "BAG": bag, "NOWHERE": tmp_path / "nowhere"}
    given = []
    for text in bags:
        name, equals, place = text.rpartition("=")
        given.append(f"{name}{equals}{places.get(place, place)}")
    code, _, errors = run(capsys, "hand_eye", *given, "--into", tmp_path / "scope.yaml", "--board", BOARD)
    assert code == 1
    assert len(errors) == 1, errors
    assert reason in errors[0]


def test_a_bag_without_metadata_is_read_as_by_check_and_process(
    step_bags: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "bare"
    folder.mkdir()
    shutil.copy(step_bags[0] / "board_0.mcap", folder / "board_0.mcap")
    hashes = []
    for number, place in enumerate((step_bags[0], folder, folder / "board_0.mcap")):
        out = tmp_path / f"{number}.yaml"
        code, _, errors = run(capsys, "intrinsics", place, "--into", out, "--board", BOARD, "--views", 8)
        assert (code, errors) == (0, [])
        hashes.append(load_calibration(out).hash)
    assert len(set(hashes)) == 1


def test_a_cut_bag_is_calibrated_by_what_is_left_or_refused_in_one_line(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    content = (bag / "bag_0.mcap").read_bytes()
    ends = []
    for share in (0.0005, 0.02, 0.3, 0.7):
        cut = tmp_path / f"cut_{share}.mcap"
        cut.write_bytes(content[: round(share * len(content))])
        caplog.clear()
        code, _, errors = run(
            capsys, "hand_eye", cut, "--into", tmp_path / f"{share}.yaml", "--board", BOARD, "--views", 8
        )
        assert code == (1 if errors else 0)
        assert len(errors) <= 1, errors
        assert len([record for record in caplog.records if "bytes lost" in record.message]) <= 1
        ends.append(code)
    assert ends[0] == 1
    assert ends[-1] == 0


@pytest.fixture(scope="module")
def turned_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("turned") / "bag"
    make_calibration_bag(path, CalibrationRecording(seed=32, fps=5, board_s=6, oblique_s=6, pivot_s=0))
    return path


@pytest.mark.parametrize(
    "how", [[], ["--scope-pose-topic", "/knee_gap/scope_shaft/pose"]], ids=["notch", "body"]
)
def test_a_turned_scope_is_followed(
    turned_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], how: list[str]
) -> None:
    out = tmp_path / "scope.yaml"
    code, _, errors = run(capsys, "oblique", turned_bag, "--into", out, "--views", 12, "--board", BOARD, *how)
    assert (code, errors) == (0, [])
    found = load_calibration(out)
    scope = calibration_truth(CalibrationRecording(seed=32)).scope
    for turn in (-0.8, 0.0, 0.5):
        error = to_vector(inverse(found.body_to_lens(turn)) @ scope.body_to_lens(turn))
        assert np.linalg.norm(error[3:]) < 0.2e-3
        assert np.linalg.norm(error[:3]) < np.radians(0.2)
    assert found.oblique is not None
    assert found.scope_rotation(found.oblique.notch_angle + 0.3) == pytest.approx(0.3)
    if how:
        assert found.oblique.T_head_scope is not None
        assert found.scope_rotation_of_body(found.oblique.T_head_scope) == pytest.approx(0.0, abs=1e-9)


def test_a_board_in_saline_gives_the_camera_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same scope as `bag` shows, its board in a bath: its angles are Snell's of those in air."""
    recording = CalibrationRecording(seed=31, fps=5, board_s=8, oblique_s=0, pivot_s=0, medium="saline")
    truth = make_calibration_bag(tmp_path / "bath", recording)
    out = tmp_path / "scope.yaml"
    board = ["--board", BOARD, "--views", 16]
    code, _, errors = run(
        capsys, "intrinsics", tmp_path / "bath", "--into", out, *board, "--medium", "saline"
    )
    assert (code, errors) == (0, [])
    found = load_calibration(out)
    assert found.medium == SALINE
    camera, lens = found.require_camera().camera(), truth.lens
    angle = np.linspace(0.0, 2.0 * np.pi, 24)
    offset = 0.85 * lens.radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels = offset + np.array([lens.centre_x_px, lens.centre_y_px])
    apart = np.linalg.norm(camera.bearings(pixels) - lens.bearings(pixels), axis=1)
    assert np.degrees(apart.max()) < 0.1
    in_air = calibration_truth(CalibrationRecording(seed=31)).lens
    assert np.degrees(np.linalg.norm(in_air.bearings(pixels) - lens.bearings(pixels), axis=1).min()) > 5.0
    # The next step takes the file's medium, and refuses another; `show` names it.
    code, _, errors = run(capsys, "intrinsics", tmp_path / "bath", "--into", out, *board, "--medium", "air")
    assert code == 1
    assert "was calibrated in saline, not in air" in errors[0]
    assert "calibrated in saline, refractive index 1.336" in run(capsys, "show", out)[1]
