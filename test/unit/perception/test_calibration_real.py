"""Calibration of a tracked laparoscope, made and recorded, and distances of known dots measured with it."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from recordings import origins
from tracked_laparoscope import SIZE, TRACKED_LAPAROSCOPE, tracked_laparoscope

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import MeasurementError
from knee_gap_perception.calibrate.measurements.boards import BoardView
from knee_gap_perception.calibrate.solvers.hand_eye import HandEye, calibrate_hand_eye
from knee_gap_perception.calibrate.solvers.hand_eye_bundle import TrackedView
from knee_gap_perception.calibrate.solvers.intrinsics import fit_intrinsics
from knee_gap_perception.calibrate.solvers.lens_error import lens_errors
from knee_gap_perception.calibrate.solvers.pivot import calibrate_pivot
from knee_gap_perception.camera.projection import LensModel
from knee_gap_uncertainty.two_view.gap_range import gap_range

ORIGINS = origins(TRACKED_LAPAROSCOPE)


def transform_mm(path: Path) -> Array:
    T = np.loadtxt(path)
    T[:3, 3] *= 1e-3
    return np.asarray(T)


def session(folder: Path) -> list[TrackedView]:
    model = {int(row[0]): row[1:4] * 1e-3 for row in np.loadtxt(folder / "April216mm_centres.txt")}
    tracked = []
    for index in range(4):
        rows = np.loadtxt(folder / "session_15-04-12" / f"calib.left.points.{index}.txt")
        ids = rows[:, 0].astype(int)
        view = BoardView(index, ids, np.array([model[i] for i in ids]), rows[:, 1:])
        T_world_body = transform_mm(folder / "session_15-04-12" / f"calib.tracking.{index}.4x4")
        tracked.append(TrackedView(view, T_world_body, np.zeros(6)))
    return tracked


def calibrated(tracked: list[TrackedView], model: LensModel) -> HandEye:
    fit = fit_intrinsics([view.board for view in tracked], *SIZE, model)
    return calibrate_hand_eye(tracked, fit.intrinsics, model)


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("name", ["plumb_bob", "equidistant"])
def test_dot_distances_by_motion_stereo(origin: str, name: str, tmp_path: Path) -> None:
    """Every distance of two dots lies in its worst-case range, and the median ratio is right to 5 %."""
    tracked = session(tracked_laparoscope(origin, tmp_path).folder)
    found = calibrated(tracked, LensModel(name))
    camera = found.intrinsics.camera()
    ratios, inside, total = [], 0, 0
    rng = np.random.default_rng(1)
    for first, second in combinations(tracked, 2):
        ids, in_first, in_second = np.intersect1d(first.board.ids, second.board.ids, return_indices=True)
        lens = [view.T_world_body @ found.T_body_lens for view in (first, second)]
        translation_error, angular_error = lens_errors(first.T_world_body, second.T_world_body, found)
        bearings = [
            camera.bearings(view.board.pixels[chosen]) @ T[:3, :3].T
            for view, chosen, T in zip((first, second), (in_first, in_second), lens, strict=True)
        ]
        points = first.board.points[in_first]
        pairs = list(combinations(range(len(ids)), 2))
        for i, j in [pairs[k] for k in rng.choice(len(pairs), min(25, len(pairs)), replace=False)]:
            true = float(np.linalg.norm(points[i] - points[j]))
            total += 1
            try:
                measured = gap_range(
                    lens[0][:3, 3], lens[1][:3, 3], bearings[0][[i, j]], bearings[1][[i, j]],
                    angular_error=angular_error, translation_error=translation_error,
                )  # fmt: skip
            except MeasurementError:
                continue
            ratios.append(measured.gap / true)
            inside += measured.gap_min <= true <= measured.gap_max
    assert np.median(ratios) == pytest.approx(1.0, abs=0.05)
    assert inside == len(ratios) > 0.5 * total


@pytest.mark.parametrize("origin", ORIGINS)
def test_pivoting_a_real_scope(origin: str, tmp_path: Path) -> None:
    """Halves of the recording agree within their stated errors, and with the truth where it is known."""
    recording = tracked_laparoscope(origin, tmp_path)
    poses = np.array([transform_mm(path) for path in sorted((recording.folder / "pivot").glob("*.txt"))])
    whole, halves = calibrate_pivot(poses), (calibrate_pivot(poses[:200]), calibrate_pivot(poses[200:]))
    assert whole.rms < 4e-3
    difference = halves[0].tip - halves[1].tip
    spread = halves[0].covariance + halves[1].covariance
    assert difference @ np.linalg.solve(spread, difference) < 16.3  # 99.9 % of 3 degrees of freedom
    if recording.tip is not None:
        error = whole.tip - recording.tip
        assert error @ np.linalg.solve(whole.covariance, error) < 16.3
