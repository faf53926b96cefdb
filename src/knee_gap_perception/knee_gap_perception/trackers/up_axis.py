"""Conversion of Motive's axes to those of ROS, applied once at the input.

Motive's ground is X-Z with Y up unless it is set otherwise; REP-103 has Z up. A body of a Y-up stream is
converted to what Motive would send with its up axis set to Z: the ground rotated about X (x, y, z -> x, -z,
y), and the axes of the body with it. So a calibration of the body is valid for both settings of Motive.
"""

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

UP_AXES = ("y", "z")


def position_z_up(position: npt.ArrayLike, up_axis: str) -> Array:
    """Positions (..., 3) [m] with Z up, of positions whose up axis is `up_axis`."""
    return _z_up(np.asarray(position, dtype=np.float64), up_axis)


def quaternion_z_up(quaternion_xyzw: npt.ArrayLike, up_axis: str) -> Array:
    """Quaternions (..., 4) with Z up: C R C^T, for the rotation C of the axes, rotates the axis of R."""
    quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    return np.concatenate([_z_up(quaternion[..., :3], up_axis), quaternion[..., 3:]], axis=-1)


def _z_up(vectors: Array, up_axis: str) -> Array:
    if up_axis not in UP_AXES:
        raise PerceptionError(f"up_axis must be one of {', '.join(UP_AXES)}, not '{up_axis}'")
    if up_axis == "z":
        return vectors.copy()
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)
