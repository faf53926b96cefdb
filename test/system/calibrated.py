"""A simulated scope with a calibration of its own, and bags processed with it."""

import subprocess
from pathlib import Path
from typing import Any

from knee_gap_bringup.launching.processes import executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_perception.calibrate.command import main as calibrate
from knee_gap_simulation.calibration.bag import CalibrationRecording, make_calibration_bag

# Of the scope; recordings are made with it by `scope_of`.
SEED = 61


def calibrated_scope(folder: Path, step: str, *, oblique_s: float, views: int) -> Path:
    """What `calibrate intrinsics` and `calibrate STEP` write from a small bag whose images are 12 ms late."""
    recording = CalibrationRecording(seed=SEED, fps=5, board_s=8, oblique_s=oblique_s, pivot_s=0)
    make_calibration_bag(folder / "board", recording)
    for each in ("intrinsics", step):
        into = ["--board", "charuco:12x9:3:2", "--into", str(folder / "scope.yaml"), "--views", str(views)]
        assert calibrate([each, str(folder / "board"), *into]) == 0
    return folder / "scope.yaml"


def process(bag: Path, out: Path, file: Path) -> "subprocess.CompletedProcess[str]":
    """Run `process` with a parameter file."""
    command = [executable("knee_gap_replay", "process"), str(bag), str(out), "--params-file", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def messages(bag: Path, topic: str) -> list[Any]:
    """All messages of a topic."""
    with BagReader(bag) as reader:
        return [reader.deserialize(entry) for entry in reader.messages([topic])]
