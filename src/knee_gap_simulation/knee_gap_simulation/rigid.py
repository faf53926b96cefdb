"""Rigid transforms as 4x4 matrices: ``T_a_b`` maps b coordinates to a."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array


def transform(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """Transforms (..., 4, 4) of rotation vectors (..., 3) [rad] and translations (..., 3) [m]."""
    vectors = np.asarray(rotation, dtype=np.float64)
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape((*vectors.shape[:-1], 3, 3))
    return from_parts(matrices, translation)


def from_parts(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """Transforms (..., 4, 4) of rotation matrices (..., 3, 3) and translations (..., 3) [m]."""
    matrices = np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*matrices.shape[:-2], 4, 4))
    result[..., :3, :3] = matrices
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def inverse(T_a_b: npt.ArrayLike) -> Array:
    """The transforms T_b_a (..., 4, 4)."""
    matrix = np.asarray(T_a_b, dtype=np.float64)
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return from_parts(rotation, -(rotation @ matrix[..., :3, 3:])[..., 0])


def quaternion_xyzw(T_a_b: npt.ArrayLike) -> Array:
    """Unit quaternion (4,), order x y z w, w >= 0, of a transform's rotation."""
    return np.asarray(Rotation.from_matrix(np.asarray(T_a_b)[:3, :3]).as_quat(canonical=True))
