"""Calibration bags: the truth they carry is that of their pictures and poses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.calibration.bag import (
    CalibrationMotion,
    CalibrationRecording,
    calibration_truth,
    make_calibration_bag,
)
from knee_gap_simulation.calibration.scene import BoardCamera, RotatedScope
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.make_bag.command import main

SMALL = CalibrationRecording(seed=5, fps=5, board_s=0.6, oblique_s=0.6, pivot_s=0.5)


def test_corners_are_drawn_where_the_truth_says() -> None:
    recording = CalibrationRecording(seed=3)
    truth = calibration_truth(recording)
    motion = CalibrationMotion(recording, truth)
    camera = BoardCamera(truth.board, truth.lens, truth.scope, 3)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, truth.board.dictionary))
    board = cv2.aruco.CharucoBoard((12, 9), truth.board.square, truth.board.marker, dictionary)
    T_board_lens = motion.lens_on_board(2.0)
    grey = cv2.cvtColor(camera.frame(T_board_lens, 0.0), cv2.COLOR_BGR2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    corners = cv2.cornerSubPix(grey, corners, (3, 3), (-1, -1), stop)
    points = np.asarray(board.getChessboardCorners())[ids.ravel()]
    expected = truth.lens.pixels((points - T_board_lens[:3, 3]) @ T_board_lens[:3, :3])
    assert len(ids) > 20
    assert np.nanmedian(np.linalg.norm(corners[:, 0] - expected, axis=1)) < 0.08


def test_a_turn_moves_the_view_around_the_shaft_and_the_notch_with_the_picture() -> None:
    scope = RotatedScope()
    shaft = scope.scope.body_to_shaft()
    lenses = [scope.body_to_lens(turn) for turn in (0.0, 0.6)]
    for lens in lenses:
        assert lens[:3, 2] @ shaft[:3, 2] == pytest.approx(np.cos(scope.scope.oblique_angle))
        assert lens[:3, 3] == pytest.approx(shaft[:3, 3])
    # The tip's own up turns about the shaft; on the sensor it is seen turned by the same angle.
    up = [
        lens[:3, :3] @ [np.sin(turn), -np.cos(turn), 0.0]
        for lens, turn in zip(lenses, (0.0, 0.6), strict=True)
    ]
    across = [u - (u @ shaft[:3, 2]) * shaft[:3, 2] for u in up]
    cosine = across[0] @ across[1] / np.linalg.norm(across[0]) / np.linalg.norm(across[1])
    assert np.arccos(cosine) == pytest.approx(0.6)


def test_a_bag_carries_its_truth_and_is_the_same_again(tmp_path: Path) -> None:
    truth = make_calibration_bag(tmp_path / "one", SMALL)
    make_calibration_bag(tmp_path / "two", SMALL)
    bags = []
    for name in ("one", "two"):
        with BagReader(tmp_path / name) as reader:
            bags.append([(m.topic, m.time_ns, m.data) for m in reader.messages()])
            reported = json.loads(reader.metadata["knee_gap_calibration_truth"])
    assert bags[0] == bags[1]
    assert reported["time_offset"] == pytest.approx(-0.012)
    assert reported["T_body_lens"]["translation"] == pytest.approx(truth.scope.body_to_lens(0.0)[:3, 3])


def test_the_tip_stays_while_pivoting() -> None:
    recording = CalibrationRecording(seed=4)
    truth = calibration_truth(recording)
    motion = CalibrationMotion(recording, truth)
    times = np.linspace(motion.image_end + 0.01, motion.end, 40)
    tips = [(motion.body(time) @ [*truth.tip, 1.0])[:3] for time in times]
    assert np.ptp(tips, axis=0) == pytest.approx(0, abs=1e-12)
    turned = [inverse(motion.body(times[0]))[:3, :3] @ motion.body(time)[:3, :3] for time in times]
    assert max(np.arccos((np.trace(R) - 1) / 2) for R in turned) > 0.3


def test_make_bag_makes_calibration_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--calibration", "--duration-s", "0.4", "--fps", "5", "--seed", "9"]
    assert main([str(tmp_path / "bag"), *small, "--video-delay-ms", "-20"]) == 0
    with BagReader(tmp_path / "bag") as reader:
        assert json.loads(reader.metadata["knee_gap_calibration_truth"])["time_offset"] == pytest.approx(0.02)
    assert main([str(tmp_path / "other"), "--calibration", "--level", "2"]) == 1
    assert "--calibration shows a board" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ({"seed": -1}, "seed"),
        ({"fps": 1}, "fps"),
        ({"pivot_s": -1}, "pivot_s"),
        ({"video_delay": 1}, "delay"),
    ],
)
def test_impossible_recordings_are_refused(setting: dict[str, float], reason: str) -> None:
    with pytest.raises(SimulationError, match=reason):
        CalibrationRecording(**setting)  # type: ignore[arg-type]
