"""An oblique scope that is turned in its camera head while it measures: its notch shows by how much."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from calibrated import SEED, calibrated_scope, messages, process
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Client

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_msgs.msg import GapEstimate, ScopeNotch
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_replay.report.comparison import compare
from knee_gap_simulation.make_bag.command import Recording, make_bag
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

DOMAIN = 63
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
TURNED = Recording(
    seed=32, duration_s=3.5, fps=30.0, scope_of=SEED, video_delay=0.012, turn=float(np.radians(-25.0))
)
VALID, TRACKING_LOST = GapEstimate.STATUS_VALID, GapEstimate.STATUS_TRACKING_LOST

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `calibrate oblique` writes from a bag in which the light post is turned as well."""
    folder = tmp_path_factory.mktemp("calibration")
    return calibrated_scope(folder, "oblique", oblique_s=8, views=24)


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("turned") / "bag"
    make_bag(bag, TURNED, progress=False)
    return bag


def parameters(folder: Path, calibration: Path, *by_notch: bool) -> Path:
    """Parameters of segmentation_node and tracking_node."""
    lines = []
    for node, notch in zip(("segmentation_node", "tracking_node"), by_notch, strict=True):
        lines += [f"/**/{node}:", "  ros__parameters:", f'    calibration_file: "{calibration}"']
        lines += [f"    scope_rotation_notch: {str(notch).lower()}"]
    path = folder / "parameters.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_the_gap_is_right_while_the_scope_rotations(calibration: Path, turned: Path, tmp_path: Path) -> None:
    done = process(turned, tmp_path / "out", parameters(tmp_path, calibration, True, True))
    assert done.returncode == 0, done.stderr
    comparison = compare(turned, tmp_path / "out")
    assert comparison.valid.sum() > 40
    assert comparison.inside == 1.0
    assert comparison.median_point_error < 0.15e-3
    assert comparison.median_error < 0.3e-3
    observations = messages(tmp_path / "out", "/knee_gap/scope_notch")
    seen = {(s.header.stamp.sec, s.header.stamp.nanosec): s.angle for s in observations if s.seen}
    assert np.ptp(np.unwrap(list(seen.values()))) > np.radians(24)
    poses = messages(tmp_path / "out", "/knee_gap/scope_pose")
    # A pose at each image whose notch was seen, and at no other time.
    assert {(p.header.stamp.sec, p.header.stamp.nanosec) for p in poses} == set(seen)
    turns = {
        (t.header.stamp.sec, t.header.stamp.nanosec): t.turn
        for t in messages(tmp_path / "out", "/knee_gap/scope_rotation")
    }
    assert set(turns) == set(seen)
    assert np.ptp([np.angle(np.exp(1j * (turns[stamp] - seen[stamp]))) for stamp in seen]) < 1e-9


def test_a_turn_that_is_not_told_of_makes_it_wrong(calibration: Path, turned: Path, tmp_path: Path) -> None:
    done = process(turned, tmp_path / "out", parameters(tmp_path, calibration, False, False))
    assert done.returncode == 0, done.stderr
    comparison = compare(turned, tmp_path / "out")
    assert comparison.valid.sum() == 0 or comparison.median_point_error > 0.5e-3


def test_offline_the_two_nodes_must_agree(calibration: Path, turned: Path, tmp_path: Path) -> None:
    done = process(turned, tmp_path / "out", parameters(tmp_path, calibration, True, False))
    assert done.returncode == 1
    assert "scope_rotation_notch must be the same" in done.stderr


def live(folder: Path, processes: Processes, bag: Path, file: Path) -> None:
    """Start the nodes, and the bag as slowly as a busy machine needs."""
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
    play = [executable("knee_gap_replay", "play"), str(bag), "--clock", "--rate", "0.4", "--loop"]
    processes.start("play", [*play, "--topics", *topics, "--wait-for", *topics, "--delay", "1"])


def test_live_it_is_right_too(calibration: Path, turned: Path, tmp_path: Path) -> None:
    file = parameters(tmp_path, calibration, True, True)
    assert process(turned, tmp_path / "out", file).returncode == 0
    # Of the points that a track begins with, which live may be those of another image: somewhat.
    truth = float(np.nanmedian(compare(turned, tmp_path / "out").truth))
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        for kind, topic in (
            (GapEstimate, "gap"),
            (ScopeNotch, "scope_notch"),
            (PoseWithCovarianceStamped, "scope_pose"),
        ):
            client.listen(kind, topic)
        live(tmp_path, processes, turned, file)

        def valid() -> list[GapEstimate]:
            return [gap for gap in client.received["gap"] if gap.status == VALID]

        client.spin_until(lambda: len(valid()) > 20, timeout=90.0)
        assert np.median([abs(gap.gap - truth) for gap in valid()]) < 0.3e-3
        seen = {
            (s.header.stamp.sec, s.header.stamp.nanosec) for s in client.received["scope_notch"] if s.seen
        }
        posed = {(p.header.stamp.sec, p.header.stamp.nanosec) for p in client.received["scope_pose"]}
        assert posed <= seen
    assert load_calibration(calibration).require_notch().depth == pytest.approx(0.05, abs=0.01)


def test_live_without_word_of_the_notch_nothing_is_valid(
    calibration: Path, turned: Path, tmp_path: Path
) -> None:
    file = parameters(tmp_path, calibration, False, True)
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        client.listen(GapEstimate, "gap")
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(DiagnosticArray, "/diagnostics")
        live(tmp_path, processes, turned, file)
        words: set[str] = set()

        def reported() -> bool:
            for array in client.received["/diagnostics"]:
                words.update(s.message for s in array.status if s.name == "/knee_gap/tracking_node")
            return any("no scope_notch received" in one for one in words) and len(client.received["gap"]) > 20

        client.spin_until(reported, timeout=90.0)
        assert not client.received["scope_pose"]
        assert all(gap.status != VALID and np.isnan(gap.gap) for gap in client.received["gap"])
