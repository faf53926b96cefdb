"""Pivot calibration: position of the scope's tip on its body, from rotations about the stationary tip.

Every pose gives R tip + t = pivot, linear in both points (the algebraic one-step method; Yaniv 2015).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

MIN_POSES = 30
MIN_TURN = np.radians(4.0)  # RMS rotation about each of two axes
OUTLIER_SIGMAS = 4.0
UNKNOWNS = 6  # of tip and pivot together
BLOCK_POSES = 100


@dataclass(frozen=True)
class Pivot:
    """`tip` (3,) [m] in the body's frame, its covariance (3, 3) [m^2], and the `pivot` (3,) [m] in the world.

    `rms` [m] is the RMS distance between the pivot and the tip by the poses.
    """

    tip: Array
    covariance: Array
    pivot: Array
    rms: float
    pose_count: int
    outlier_count: int


def calibrate_pivot(T_world_body: npt.ArrayLike) -> Pivot:
    """Tip and pivot from poses (n, 4, 4) of a body that pivots.

    Raises PerceptionError with advice for too few poses and for pivoting without rotation.
    """
    T = np.asarray(T_world_body, dtype=np.float64)
    T = T[np.isfinite(T).all(axis=(1, 2))]
    if len(T) < MIN_POSES:
        raise PerceptionError(f"{len(T)} tracked poses are too few to pivot; at least {MIN_POSES} are needed")
    _check_rotation(T)
    keep = np.ones(len(T), dtype=bool)
    solution, residual = np.empty(6), np.empty((0, 3))
    for _ in range(5):
        solution, residual = _solve(T[keep]), np.empty((0, 3))
        residual = T[:, :3, :3] @ solution[:3] + T[:, :3, 3] - solution[3:]
        length = np.linalg.norm(residual, axis=1)
        # The median length of a 3D Gaussian vector is 1.538 sigma.
        now = length <= OUTLIER_SIGMAS * np.sqrt(3) * float(np.median(length)) / 1.538
        if (now == keep).all():
            break
        keep = now
    _check_rotation(T[keep])
    return _result(T[keep], solution, residual[keep], int((~keep).sum()))


def _check_rotation(T: Array) -> None:
    """Raise PerceptionError without rotation about two axes: the tip is undetermined along a single axis."""
    rotations = Rotation.from_matrix(T[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    turn = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(T))
    if turn[1] < MIN_TURN:
        raise PerceptionError(
            f"pivoting needs rotation: the scope rotates by {np.degrees(turn[0]):.1f} deg (RMS) about one "
            f"axis and {np.degrees(turn[1]):.1f} deg about a second; at least {np.degrees(MIN_TURN):.0f} deg "
            "about both are needed: rest the tip in a dimple and swing the handle in wide circles"
        )


def _solve(T: Array) -> Array:
    design = np.concatenate([T[:, :3, :3], np.broadcast_to(-np.eye(3), (len(T), 3, 3))], axis=2)
    return np.asarray(np.linalg.lstsq(design.reshape(-1, 6), -T[:, :3, 3].ravel(), rcond=None)[0])


def _result(T: Array, solution: Array, residual: Array, outliers: int) -> Pivot:
    """Covariance by blocks of poses, since a slip of the tip lasts longer than one sample."""
    blocks = np.array_split(np.arange(len(T)), min(len(T), int(np.clip(len(T) // BLOCK_POSES, 8, 40))))
    design = np.concatenate([T[:, :3, :3], np.broadcast_to(-np.eye(3), (len(T), 3, 3))], axis=2)
    information = np.einsum("nki,nkj->ij", design, design)
    scores = np.array([np.einsum("nki,nk->i", design[b], residual[b]) for b in blocks])
    bread = np.linalg.inv(information)
    covariance = bread @ (scores.T @ scores * len(blocks) / (len(blocks) - UNKNOWNS)) @ bread
    return Pivot(
        tip=solution[:3],
        covariance=covariance[:3, :3],
        pivot=solution[3:],
        rms=float(np.sqrt((residual**2).sum(axis=1).mean())),
        pose_count=len(T),
        outlier_count=outliers,
    )
