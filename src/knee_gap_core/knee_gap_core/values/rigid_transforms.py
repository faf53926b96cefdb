"""Rigid motions as 4x4 matrices, `T_a_b` maps b coordinates to a, and their small changes.

A twist is (rotation, translation) (6,) in the moving frame: T exp(twist), rotation vector [rad] first.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array


def rigid(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """Transforms (..., 4, 4) of rotation matrices (..., 3, 3) and translations (..., 3) [m]."""
    matrix = np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*matrix.shape[:-2], 4, 4))
    result[..., :3, :3] = matrix
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def from_rotation_vectors(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """Transforms (..., 4, 4) of rotation vectors (..., 3) [rad] and translations (..., 3) [m]."""
    vectors = np.asarray(rotation, dtype=np.float64)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape((*vectors.shape[:-1], 3, 3))
    return rigid(matrices, translation)


def quaternion_xyzw(T_a_b: npt.ArrayLike) -> Array:
    """Unit quaternion (4,), order x y z w, w >= 0, of a transform's rotation."""
    return np.asarray(Rotation.from_matrix(np.asarray(T_a_b)[:3, :3]).as_quat(canonical=True))


def from_vector(vector: npt.ArrayLike) -> Array:
    """Transform (4, 4) of a rotation vector [rad] and a translation [m] in one array (6,)."""
    v = np.asarray(vector, dtype=np.float64)
    return rigid(Rotation.from_rotvec(v[:3]).as_matrix(), v[3:])


def to_vector(T_a_b: npt.ArrayLike) -> Array:
    """Rotation vector [rad] and translation [m] (6,) of a transform (4, 4)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])


def inverse(T_a_b: npt.ArrayLike) -> Array:
    """The transforms T_b_a (..., 4, 4)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    back = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid(back, -(back @ T[..., :3, 3:])[..., 0])


def apply(T_a_b: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Points (n, 3) of frame b in frame a."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3])


def skew(vectors: npt.ArrayLike) -> Array:
    """Matrices (..., 3, 3) whose product with w is the cross product of v and w."""
    v = np.asarray(vectors, dtype=np.float64)
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result


def angle_between(T_a: npt.ArrayLike, T_b: npt.ArrayLike) -> float:
    """Angle [rad] of the rotation between two transforms (4, 4) or rotation matrices (3, 3)."""
    difference = np.asarray(T_a)[:3, :3].T @ np.asarray(T_b)[:3, :3]
    return float(Rotation.from_matrix(difference).magnitude())


def mean(transforms: npt.ArrayLike) -> Array:
    """Mean (4, 4) of transforms (n, 4, 4): chordal mean of the rotations, mean of the translations."""
    T = np.asarray(transforms, dtype=np.float64)
    return rigid(Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix(), T[:, :3, 3].mean(axis=0))
