"""Poses as values: a body that the tracker follows, and the lens that is fixed to it."""

from dataclasses import dataclass, field
from math import inf, nan
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.quaternions import matrix, unit_quaternion

# No tracker sees farther [m]; what lies beyond is not a place, and its square may not be a number.
FARTHEST = 1000.0
UNIT_TOLERANCE = 1e-3  # [-] by which a quaternion's length may differ from 1


@dataclass(frozen=True, eq=False)
class BodyPose:
    """One tracked rigid body at one exposure of the tracker's cameras.

    `position` (3,) [m] and `quaternion_xyzw` (4,) map body coordinates to the tracker's frame.
    `tracking_valid` is whether the tracker reports that it sees the body; `mean_error` the mean residual of
    its markers [m], NaN if the tracker does not report it. `stamp_ns` is the time of exposure, or of arrival
    if `stamp_is_arrival`. Nothing here is checked: `pose_validity` does that.
    """

    stamp_ns: int
    position: Array
    quaternion_xyzw: Array
    name: str = ""
    tracking_valid: bool = True
    mean_error: float = nan
    stamp_is_arrival: bool = False


@dataclass(frozen=True, eq=False)
class LensPose:
    """Pose of the lens, with its error: the fields of geometry_msgs/PoseWithCovarianceStamped.

    `position` (3,) [m] and `quaternion_xyzw` (4,) map coordinates of `child_frame_id` (z along the view, x to
    the right, y down) to `frame_id`. `covariance` (6, 6) is that of position [m^2] and of a small rotation
    [rad^2] about the fixed axes of `frame_id`, in the order x, y, z, rotation about x, y, z (REP-103).
    `motion` (6,) is the velocity [m/s] and the angular velocity about the same axes [rad/s], measured over
    `motion_time` [s]; NaN if not known. `scope_rotation` [rad] is how far the scope is turned in its camera
    head since its calibration. `segment` counts the breaks in the poses before it, if they are checked: poses
    of one segment are continuous (`pose_continuity`).
    """

    stamp_ns: int
    frame_id: str
    position: Array
    quaternion_xyzw: Array
    covariance: Array
    motion: Array = field(default_factory=lambda: np.full(6, nan))
    motion_time: float = inf
    scope_rotation: float = 0.0
    segment: int = 0
    child_frame_id: str = ""

    def matrix(self) -> Array:
        """Return the pose as `T_world_lens` (4, 4), which maps lens coordinates to `frame_id`."""
        return rigid_transform(self.position, self.quaternion_xyzw)


class FramePose(NamedTuple):
    """The pose of a frame in its parent, as /tf has it: `position` (3,) [m], `quaternion_xyzw` (4,)."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position: Array
    quaternion_xyzw: Array


def rigid_transform(position: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike) -> Array:
    """4x4 matrix of a position (3,) and a quaternion (4,), which is brought to unit length."""
    T = np.eye(4)
    T[:3, :3] = matrix(unit_quaternion(np.array(quaternion_xyzw, dtype=np.float64)))
    T[:3, 3] = position
    return T


def is_unit(quaternion: Array) -> bool:
    """Whether a quaternion (4,) is of unit length, within what rounding and drivers leave."""
    # Compared before it is squared, which overflows.
    if not np.abs(quaternion).max() <= 2.0:
        return False
    return abs(float(np.linalg.norm(quaternion)) - 1.0) <= UNIT_TOLERANCE


def is_place(position: Array) -> bool:
    """Whether a position (3,) [m] is finite, and not farther than any tracker sees."""
    return bool(np.abs(position).max() <= FARTHEST)
