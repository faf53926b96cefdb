"""Mistakes at the start of real nodes: one line of ours, exit code 2, and no traceback."""

import os
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from sample_bag import SAMPLE

from knee_gap_bringup.launching.processes import executable

pytestmark = pytest.mark.system
ENVIRONMENT = {**os.environ, "ROS_DOMAIN_ID": "146", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@pytest.mark.parametrize(
    ("package", "node", "arguments", "words"),
    [
        ("knee_gap_perception", "tracking_node", ["-p", "use_sim_time:=abc"], "expecting type 'BOOL'"),
        (
            "knee_gap_perception",
            "segmentation_node",
            ["-p", "use_sim_timeX:=true"],
            "no parameter use_sim_timeX",
        ),
        ("knee_gap_uncertainty", "uncertainty_node", ["-p", "use_sim_time:=1"], "expecting type 'BOOL'"),
        (
            "knee_gap_perception",
            "segmentation_node",
            ["-p", "calibration_file:=~nosuchuser_at_all/scope.yaml"],
            "there is no such user",
        ),
        ("knee_gap_uncertainty", "uncertainty_node", ["--params-file", "FIFO"], "is a FIFO, not a file"),
        ("knee_gap_bringup", "leg_controller_node", ["--params-file", "NONE"], "No such file"),
    ],
)
def test_a_mistake_ends_a_node_in_one_line(
    tmp_path: Path, package: str, node: str, arguments: list[str], words: str
) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    places = {"FIFO": str(tmp_path / "fifo.yaml"), "NONE": str(tmp_path / "none.yaml")}
    given = [places.get(argument, argument) for argument in arguments]
    done = subprocess.run(
        [executable(package, node), "--ros-args", *given],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=ENVIRONMENT,
    )
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("cannot start: ")
    assert words in lines[0]


@pytest.mark.parametrize("command", [["play", "BAG"], ["record", "OUT", "/topic"]], ids=["play", "record"])
@pytest.mark.parametrize("parameter", ["use_sim_time:=abc", "use_sim_timeX:=true"])
def test_a_mistake_ends_play_and_record_in_one_line(
    tmp_path: Path, command: list[str], parameter: str
) -> None:
    places = {"BAG": str(SAMPLE), "OUT": str(tmp_path / "out")}
    name, *given = (places.get(word, word) for word in command)
    done = subprocess.run(
        [executable("knee_gap_replay", name), *given, "--ros-args", "-p", parameter],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=ENVIRONMENT,
    )
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert parameter.partition(":")[0] in done.stderr
    assert not (tmp_path / "out").exists()
