"""Boards found in drawn pictures, where their points are known."""

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_perception.calibrate.measurements.boards import CharucoBoard, DotGrid, board_from_text
from knee_gap_perception.errors import PerceptionError
from knee_gap_simulation.calibration.bag import CalibrationMotion, CalibrationRecording, calibration_truth
from knee_gap_simulation.calibration.scene import BoardCamera


def warped(flat: npt.NDArray[np.uint8], homography: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    picture = cv2.warpPerspective(flat, homography, (900, 700), borderValue=[200])
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), dtype=np.uint8)


HOMOGRAPHY = np.array([[0.9, -0.12, 120.0], [0.08, 0.85, 60.0], [1.2e-4, 1.5e-4, 1.0]])


def test_charuco_corners_are_where_they_were_drawn() -> None:
    board = board_from_text("charuco:9x7:3:2")
    assert isinstance(board, CharucoBoard)
    flat = board.opencv().generateImage((9 * 80, 7 * 80), marginSize=0)
    view = board.find(warped(flat, HOMOGRAPHY), 42)
    assert view is not None
    assert view.stamp_ns == 42
    assert len(view.ids) == 8 * 6
    drawn = view.points[:, :2] / 0.003 * 80 - 0.5
    expected = cv2.perspectiveTransform(drawn[:, None], HOMOGRAPHY)[:, 0]
    assert np.abs(view.pixels - expected).max() < 0.25  # the drawing itself is warped without antialiasing


@pytest.mark.parametrize("kind", ["dots", "symmetric_dots"])
def test_dots_are_where_they_were_drawn(kind: str) -> None:
    board = board_from_text(f"{kind}:4x9:2.5")
    assert isinstance(board, DotGrid)
    flat = np.full((700, 700), 230, np.uint8)
    drawn = board.points[:, :2] / 0.0025 * 48 + 90
    for x, y in drawn:
        cv2.circle(flat, (round(x * 16), round(y * 16)), 15 * 16, [20], -1, cv2.LINE_AA, 4)
    view = board.find(warped(flat, HOMOGRAPHY), 0)
    assert view is not None
    assert board.has_orientation == (kind == "dots")
    expected = cv2.perspectiveTransform(drawn[:, None], HOMOGRAPHY)[:, 0]
    error = np.linalg.norm(view.pixels[:, None] - expected[None], axis=2)
    assert error.min(axis=1).max() < 0.6
    if board.has_orientation:
        assert np.diag(error).max() < 0.6


def test_no_board_is_none() -> None:
    grey = np.full((480, 640), 120, np.uint8)
    assert board_from_text("charuco:9x7:3:2").find(grey, 0) is None
    assert board_from_text("dots:4x9:2.5").find(grey, 0) is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("chess:9x7:3", "a board is charuco"),
        ("charuco:9x7:3", "a board is charuco"),
        ("charuco:9:3:2", "a board is charuco"),
        ("charuco:9x7:2:3", "smaller than its square"),
        ("charuco:9x7:3:2:DICT_9X9", "no marker dictionary"),
        ("charuco:2x2:3:2", "at least 3x3"),
        ("dots:4x9:-1", "pitch above 0"),
    ],
)
def test_other_boards_are_refused(text: str, reason: str) -> None:
    with pytest.raises(PerceptionError, match=reason):
        board_from_text(text)


@pytest.mark.parametrize("lens", ["equidistant", "pinhole"])
def test_dots_are_found_on_a_table_that_shows_more_blobs_than_the_board(lens: str) -> None:
    recording = CalibrationRecording(seed=200, board="dots", lens=lens)
    truth = calibration_truth(recording)
    motion = CalibrationMotion(recording, truth)
    camera = BoardCamera(truth.board, truth.lens, truth.scope, 200)
    board = board_from_text(truth.board.text)
    found = 0
    for time in np.linspace(0.0, 15.0, 8):
        T_board_lens = motion.lens_on_board(time)
        view = board.find(camera.frame(T_board_lens, 0.0), 0)
        if view is None:
            continue
        found += 1
        expected = truth.lens.pixels((view.points - T_board_lens[:3, 3]) @ T_board_lens[:3, :3])
        assert np.abs(view.pixels - expected).max() < 0.5
    assert found >= 6
