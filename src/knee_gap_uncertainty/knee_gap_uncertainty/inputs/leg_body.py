"""A second tracked body of the leg: where it moves the points of the gap do, though no residual need show it.

A point that slips along its ray, or moves while no image is taken, looks to the scope like another depth. A
body fixed to the bone does not. It is watched in the frame that the lens poses are given in: in the room, or,
where they are given in one body of the leg, against that body.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.inputs.pose_buffer import PoseBuffer, PoseRefusal

# How many times `max_pose_age` the body's pose may be from the image: it is not interpolated.
AGES = 2.0


class LegBody:
    """The body's latest pose, and how far it carried what lies at the lens since a pose before.

    `max_pose_age` [s] as in PoseBuffer, which judges the poses.
    """

    def __init__(self, max_pose_age: float) -> None:
        self._poses = PoseBuffer(max_pose_age, capacity=2, needs_error=False)
        self._longest_ns = round(AGES * max_pose_age * 1e9)
        self.pose: LensPose | None = None

    def add(self, pose: LensPose) -> PoseRefusal | None:
        """Take a pose of the body, or return why not."""
        refusal = self._poses.add(pose)
        if refusal is None:
            self.pose = pose
        return refusal

    def flaw(self, stamp_ns: int, frame_id: str) -> str:
        """Why the body cannot be used at an image with a lens pose in `frame_id`; empty if it can."""
        if self.pose is None:
            return "no pose of the leg body arrives"
        if self.pose.frame_id != frame_id:
            return f"the leg body's pose is given in {self.pose.frame_id}, the lens's in {frame_id}"
        if abs(stamp_ns - self.pose.stamp_ns) > self._longest_ns:
            return "the leg body is not tracked any more"
        return ""

    def moved_since(self, before: LensPose, place: Array) -> float:
        """How far a point at `place` (3,) [m] went that was fixed to the body since the pose `before`."""
        assert self.pose is not None
        begin, now = Rotation.from_quat(before.quaternion_xyzw), Rotation.from_quat(self.pose.quaternion_xyzw)
        carried = (now * begin.inv()).apply(place - before.position) + self.pose.position
        return float(np.linalg.norm(carried - place))
