"""Recordings of a tracked laparoscope as folders of text files: made here with a known truth, and by others.

A folder holds `April216mm_centres.txt` (id, x, y, z of each dot [mm]), `session_15-04-12` with the files
`calib.left.points.N.txt` (id, column, row [px]) and `calib.tracking.N.4x4` (body to tracker [mm]) of four
views of 1920x540 pixels, and `pivot` with a pose of the body [mm] in each file.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from recordings import BESIDE, RECORDED

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import apply, from_vector, inverse
from knee_gap_perception.camera.projection import LensModel

TRACKED_LAPAROSCOPE = "images/tracked_laparoscope/session_15-04-12"
SIZE = (1920, 540)
PITCH = 6.731e-3  # [m]


class TrackedLaparoscope(NamedTuple):
    """A folder of the recording; the tip of the pivoted tool in its body's frame [m], None if not known."""

    folder: Path
    tip: Array | None


# Made: half the rows of a picture, as of an interlaced camera; a body a hand's length behind the lens.
_LENS = np.array([1800.0, 900.0, 950.0, 275.0, -0.12, 0.05, 0.0, 0.0, 0.0])
_T_BODY_LENS = from_vector([0.2, -0.1, 0.9, 0.02, -0.05, 0.31])
_T_WORLD_BOARD = from_vector([0.2, 2.9, 0.1, 0.1, -0.05, -1.6])
_TIP = np.array([0.013, -0.041, 0.335])
_SIGMA_PX, _SHIFT_ERROR, _TURN_ERROR = 0.25, 0.1e-3, 0.2e-3


def tracked_laparoscope(origin: str, folder: Path) -> TrackedLaparoscope:
    """Four views of a board of 18x12 dots, and 400 poses of pivoting about the tip."""
    if origin == RECORDED:
        return TrackedLaparoscope((BESIDE / TRACKED_LAPAROSCOPE).parent, None)
    rng = np.random.default_rng(216)
    dots = PITCH * np.stack([*np.meshgrid(np.arange(18.0), np.arange(12.0)), np.zeros((12, 18))], axis=-1)
    dots = dots.reshape(-1, 3)
    rows = [f"{index} {x * 1e3:.9f} {y * 1e3:.9f} {z * 1e3:.9f}" for index, (x, y, z) in enumerate(dots)]
    (folder / "April216mm_centres.txt").write_text("\n".join(rows) + "\n")
    session, pivot = folder / "session_15-04-12", folder / "pivot"
    session.mkdir()
    pivot.mkdir()
    _write_session(session, dots, rng)
    _write_pivot(pivot, rng)
    return TrackedLaparoscope(folder, _TIP)


def _write_session(session: Path, dots: Array, rng: np.random.Generator) -> None:
    # Places of the board's middle before the lens, and how it is tilted.
    middle = from_vector([0.0, 0.0, 0.0, *(-dots.mean(axis=0))])
    held = [
        [0.35, 0.10, 0.1, 0.006, 0.002, 0.105],
        [-0.30, 0.25, 1.3, -0.008, 0.004, 0.115],
        [0.05, -0.45, -1.1, 0.004, -0.004, 0.100],
        [-0.20, -0.30, 2.6, -0.004, 0.000, 0.120],
    ]
    for index, pose in enumerate(held):
        T_lens_board = from_vector([0.0, 0.0, 0.0, *pose[3:]]) @ from_vector([*pose[:3], 0, 0, 0]) @ middle
        exact = LensModel("plumb_bob").project(apply(T_lens_board, dots), _LENS).pixels
        seen = np.flatnonzero(((exact > 20) & (exact < np.array(SIZE) - 20)).all(axis=1))
        pixels = exact + _SIGMA_PX * rng.standard_normal(exact.shape)
        rows = [f"{i} {pixels[i, 0]:.3f} {pixels[i, 1]:.3f}" for i in seen]
        (session / f"calib.left.points.{index}.txt").write_text("\n".join(rows) + "\n")
        T_world_body = _T_WORLD_BOARD @ inverse(T_lens_board) @ inverse(_T_BODY_LENS)
        _write_transform(session / f"calib.tracking.{index}.4x4", T_world_body @ _tracker_error(rng))


def _write_pivot(pivot: Path, rng: np.random.Generator) -> None:
    place = np.array([-0.4, 0.03, -1.9])
    for k in range(400):
        t = k / 400
        turn = [0.5 * np.sin(11 * t), 0.45 * np.sin(17 * t + 1.0), 1.5 * np.sin(5 * t)]
        T = from_vector([*turn, 0.0, 0.0, 0.0])
        T[:3, 3] = place - T[:3, :3] @ _TIP
        _write_transform(pivot / f"{1_378_476_416_922_755_200 + 95_000_000 * k}.txt", T @ _tracker_error(rng))


def _tracker_error(rng: np.random.Generator) -> Array:
    sizes = np.array([_TURN_ERROR] * 3 + [_SHIFT_ERROR] * 3)
    return from_vector(sizes * rng.standard_normal(6) / np.sqrt(3.0))


def _write_transform(path: Path, T: Array) -> None:
    in_mm = T.copy()
    in_mm[:3, 3] *= 1e3
    path.write_text("\n".join(" ".join(f"{value:.10g}" for value in row) for row in in_mm) + "\n")
