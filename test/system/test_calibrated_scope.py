"""From a calibration bag to a gap: calibrate, then measure with the file, offline and in the live nodes."""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from calibrated import SEED, calibrated_scope, messages, process
from diagnostic_msgs.msg import DiagnosticArray
from live import Client

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_msgs.msg import GapEdges, GapEstimate
from knee_gap_perception.calibration.calibration_file import load_calibration, save_calibration
from knee_gap_replay.report.comparison import compare
from knee_gap_simulation.make_bag.command import Recording, make_bag
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

DOMAIN = 58
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
UNKNOWN, VALID = GapEstimate.STATUS_UNKNOWN, GapEstimate.STATUS_VALID

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `calibrate` writes from a small bag whose images are stamped 12 ms late."""
    folder = tmp_path_factory.mktemp("calibration")
    return calibrated_scope(folder, "hand_eye", oblique_s=0, views=16)


@pytest.fixture(scope="module")
def rims(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rims seen by the same scope, its images as late."""
    bag = tmp_path_factory.mktemp("rims") / "bag"
    recording = Recording(seed=32, duration_s=2.5, fps=30.0, scope_of=SEED, video_delay=0.012)
    make_bag(bag, recording, progress=False)
    return bag


@pytest.fixture(scope="module")
def wrong_size(calibration: Path) -> Path:
    """The calibration as if it had been made for half the image."""
    whole = load_calibration(calibration)
    camera = replace(whole.require_camera(), width=640, height=360)
    path = calibration.with_name("half.yaml")
    save_calibration(replace(whole, width_px=640, height_px=360, camera=camera), path)
    return path


def parameters(folder: Path, segmentation: Path | None, tracking: Path | None, **more: str) -> Path:
    """A ROS parameter file that names the calibrations of the two nodes."""
    lines = []
    for node, file in (("segmentation_node", segmentation), ("tracking_node", tracking)):
        lines += [f"/**/{node}:", "  ros__parameters:", f'    calibration_file: "{file or ""}"']
        lines += [f"    {name}: {value}" for name, value in more.items() if node == "tracking_node"]
    path = folder / "parameters.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_gap_is_measured_with_the_file(calibration: Path, rims: Path, tmp_path: Path) -> None:
    done = process(rims, tmp_path / "out", parameters(tmp_path, calibration, calibration))
    assert done.returncode == 0, done.stderr
    comparison = compare(rims, tmp_path / "out")
    assert comparison.valid.sum() > 30
    assert comparison.inside == 1.0
    assert comparison.median_point_error < 0.1e-3
    assert comparison.median_error < 0.25e-3
    reported = messages(tmp_path / "out", "/knee_gap/scope_calibration")
    digest = load_calibration(calibration).hash
    assert {(message.node, message.hash) for message in reported} == {
        ("segmentation_node", digest),
        ("tracking_node", digest),
    }


def test_images_of_another_size_give_nothing_valid(wrong_size: Path, rims: Path, tmp_path: Path) -> None:
    done = process(rims, tmp_path / "out", parameters(tmp_path, wrong_size, wrong_size))
    assert "made for images of 640x360 px, not 1280x720 px" in done.stdout
    assert {edges.status for edges in messages(tmp_path / "out", "/knee_gap/gap_edges")} == {
        GapEdges.STATUS_UNKNOWN
    }
    assert not any(gap.status == VALID for gap in messages(tmp_path / "out", "/knee_gap/gap"))


def test_a_calibration_of_one_node_only_gives_nothing_valid(
    calibration: Path, rims: Path, tmp_path: Path
) -> None:
    done = process(rims, tmp_path / "out", parameters(tmp_path, None, calibration))
    assert "different calibrations" in done.stdout
    assert not any(gap.status == VALID for gap in messages(tmp_path / "out", "/knee_gap/gap"))


@pytest.mark.parametrize(
    ("suffix", "more", "words"),
    [
        ("", {"body_to_shaft_translation": "[0.0, 0.0, 0.2]"}, "leave one of them out"),
        (".none", {}, "cannot be read"),
    ],
)
def test_offline_and_live_refuse_bad_settings_in_one_line(
    suffix: str, more: dict[str, str], words: str, calibration: Path, rims: Path, tmp_path: Path
) -> None:
    file = parameters(tmp_path, None, Path(f"{calibration}{suffix}"), **more)
    done = process(rims, tmp_path / "out", file)
    assert done.returncode != 0
    node = [executable("knee_gap_perception", "tracking_node"), "--ros-args", "--params-file", str(file)]
    live = subprocess.run(node, capture_output=True, text=True, check=False, timeout=60)
    assert live.returncode == 2
    for reported in (done.stderr, live.stderr):
        lines = [line for line in reported.splitlines() if line.strip()]
        assert len(lines) == 1
        assert words in lines[0]


def run_live(
    folder: Path, rims: Path, file: Path, until: Callable[[Client], bool]
) -> tuple[list[GapEstimate], dict[str, dict[str, str]]]:
    """The bag through the live nodes; the estimates, and each node's last diagnostics."""
    with Processes(folder, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        client.listen(GapEstimate, "gap")
        client.listen(DiagnosticArray, "/diagnostics")
        for name, package in (
            ("segmentation_node", "knee_gap_perception"),
            ("tracking_node", "knee_gap_perception"),
            ("uncertainty_node", "knee_gap_uncertainty"),
        ):
            command = [executable(package, name), "--ros-args", "-r", "__ns:=/knee_gap"]
            command += ["-p", "use_sim_time:=true"]
            if name != "uncertainty_node":
                command += ["--params-file", str(file)]
            if name == "segmentation_node":
                command += ["-p", "image_transport:=compressed"]
            processes.start(name, command)
        processes.wait_ready(["segmentation_node", "tracking_node", "uncertainty_node"], 120.0)
        topics = [IMAGE, CAMERA_INFO, BODY_POSE]
        play = [executable("knee_gap_replay", "play"), str(rims), "--clock", "--rate", "0.4", "--loop"]
        processes.start("play", [*play, "--topics", *topics, "--wait-for", *topics, "--delay", "1"])
        client.spin_until(lambda: until(client), timeout=90.0)
        client.received["/diagnostics"].clear()
        seen: dict[str, dict[str, str]] = {}

        def all_reported() -> bool:
            for array in client.received["/diagnostics"]:
                for status in array.status:
                    seen[status.name] = {pair.key: pair.value for pair in status.values}
            return len(seen) >= 3

        client.spin_until(all_reported)
        return list(client.received["gap"]), seen


def test_the_live_nodes_measure_with_it_and_say_which(calibration: Path, rims: Path, tmp_path: Path) -> None:
    def enough(client: Client) -> bool:
        return sum(gap.status == VALID for gap in client.received["gap"]) > 20

    _, reported = run_live(tmp_path, rims, parameters(tmp_path, calibration, calibration), enough)
    digest = load_calibration(calibration).hash
    assert reported["/knee_gap/segmentation_node"]["calibration"] == digest
    assert reported["/knee_gap/tracking_node"]["calibration"] == digest
    for node in ("segmentation_node", "tracking_node"):
        assert reported["/knee_gap/uncertainty_node"][f"calibration of {node}"] == digest


def test_live_a_wrong_size_and_two_calibrations_are_seen(
    calibration: Path, wrong_size: Path, rims: Path, tmp_path: Path
) -> None:
    def some(client: Client) -> bool:
        return len(client.received["gap"]) > 20

    gaps, reported = run_live(tmp_path, rims, parameters(tmp_path, wrong_size, calibration), some)
    assert not any(gap.status == VALID for gap in gaps)
    uncertainty = reported["/knee_gap/uncertainty_node"]
    assert uncertainty["calibration of segmentation_node"] != uncertainty["calibration of tracking_node"]
    assert "VALID" not in reported["/knee_gap/segmentation_node"]
