"""The pose of the lens at the stamp of an image: interpolated, or predicted beyond the tracker's last pose.

An image may be looked at before the tracker's next pose arrives. A predicted pose only guides the search
for the points in the image, so a pose with a larger, honest covariance is better than none.
"""

from collections import deque
from dataclasses import replace

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.pose_continuity import PoseContinuity
from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_core.values.quaternions import (
    between,
    from_rotation_vector,
    product,
    turn_from,
    unit_quaternion,
)

POSES = 3  # through which the motion is drawn
KEPT = 512  # poses: half a second of the fastest tracker, longer than an image is on its way
LONGEST_STEP_NS = 40_000_000  # between poses that describe one motion, and beyond the last
ACCELERATION = 0.5  # [m/s^2] of a hand, RMS
ANGULAR_ACCELERATION = 2.0  # [rad/s^2]


def _per_axis(acceleration: float, angular_acceleration: float) -> Array:
    """(6,) of each axis, as in a covariance."""
    return np.array([acceleration] * 3 + [angular_acceleration] * 3)


ACCELERATIONS = _per_axis(ACCELERATION, ANGULAR_ACCELERATION)


Pose = BodyPose | LensPose


def place_between(before: Pose, after: Pose, share: float) -> tuple[Array, Array]:
    """Position (3,) [m] and quaternion x, y, z, w (4,) at a share of the way from one pose to another.

    Positions linearly, rotations by slerp.
    """
    position: Array = (1.0 - share) * before.position + share * after.position
    return position, between(before.quaternion_xyzw, after.quaternion_xyzw, share)


def body_between(before: BodyPose, after: BodyPose, stamp_ns: int) -> BodyPose:
    """Pose of a body at a stamp [ns] between two poses."""
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    position, quaternion = place_between(before, after, share)
    return BodyPose(stamp_ns, position, quaternion, name=before.name)


def lens_between(
    before: LensPose,
    after: LensPose,
    stamp_ns: int,
    acceleration: float = ACCELERATION,
    angular_acceleration: float = ANGULAR_ACCELERATION,
) -> LensPose:
    """Pose of the lens at a stamp [ns] between two poses; all that is not interpolated is that of `after`.

    Its covariance is not averaged down, as errors of neighbours may be common, and includes what an
    acceleration [m/s^2] and angular acceleration [rad/s^2], RMS lengths, bend in between.
    """
    since, until = (stamp_ns - before.stamp_ns) / 1e9, (after.stamp_ns - stamp_ns) / 1e9
    share = since / (since + until)
    position, quaternion = place_between(before, after, share)
    covariance: Array = (1.0 - share) * before.covariance + share * after.covariance
    # A constant acceleration a bends the path by a s u / 2, s after one and u before the other pose.
    bend = since * until / 2.0
    accelerations = _per_axis(acceleration, angular_acceleration)
    return replace(
        after,
        stamp_ns=stamp_ns,
        position=position,
        quaternion_xyzw=quaternion,
        covariance=np.asarray(covariance + np.diag((accelerations * bend) ** 2 / 3.0)),
    )


class LensPosePredictor:
    """Takes lens poses in the order of their stamps and returns the pose at a stamp near the last of them."""

    def __init__(self, longest_step_ns: int = LONGEST_STEP_NS) -> None:
        """`longest_step_ns`: the longest time between poses, and from the last to the stamp asked for."""
        self._longest_step_ns = longest_step_ns
        self._poses: deque[LensPose] = deque(maxlen=KEPT)
        self._continuity = PoseContinuity()

    @property
    def break_reason(self) -> str:
        """Why the latest segment of poses began; empty for the first."""
        return self._continuity.reason

    def add(self, pose: LensPose) -> None:
        """Add the next pose; one of another frame, or from before the last, clears the earlier ones."""
        if self._poses:
            last = self._poses[-1]
            if pose.frame_id != last.frame_id or pose.stamp_ns <= last.stamp_ns:
                self._poses.clear()
        segment = self._continuity.take(
            pose.stamp_ns, pose.frame_id, pose.position, pose.quaternion_xyzw, pose.covariance
        )
        self._poses.append(replace(pose, segment=segment))

    def clear(self) -> None:
        """Forget all poses; their segments are numbered on."""
        self._poses.clear()

    def segment_at(self, stamp_ns: int) -> int | None:
        """Segment of the latest pose up to a stamp [ns]; None where no pose is as old.

        Poses of one segment follow from each other as those of a hand do, see `pose_continuity`.
        """
        segments = (pose.segment for pose in reversed(self._poses) if pose.stamp_ns <= stamp_ns)
        return next(segments, None)

    def expects_after(self, stamp_ns: int) -> bool:
        """Whether a pose after a stamp [ns] is still to come, from a tracker that has not fallen silent."""
        if not self._poses:
            return False
        return 0 < stamp_ns - self._poses[-1].stamp_ns <= self._longest_step_ns

    def at(self, stamp_ns: int) -> LensPose | None:
        """The pose at a stamp [ns] with its covariance; None where no poses are close enough."""
        near = self._motion(stamp_ns)
        if (
            len(near) < 2
            or stamp_ns - near[-1].stamp_ns > self._longest_step_ns
            or stamp_ns < near[0].stamp_ns
        ):
            return None
        times = np.array([pose.stamp_ns - stamp_ns for pose in near]) / 1e9
        # Value at time 0 of the line through the poses, as weights of the poses.
        centred = times - times.mean()
        weights = 1.0 / len(near) - times.mean() * centred / (centred @ centred)
        reference = near[-1].quaternion_xyzw
        turns = np.stack([turn_from(reference, pose.quaternion_xyzw) for pose in near])
        # A constant acceleration a adds a t^2 / 2 to each pose.
        bend = abs(float(weights @ times**2)) / 2.0
        noise = np.zeros((6, 6))
        for weight, pose in zip(weights, near, strict=True):
            noise += weight**2 * pose.covariance
        return LensPose(
            stamp_ns=stamp_ns,
            frame_id=near[-1].frame_id,
            child_frame_id=near[-1].child_frame_id,
            position=weights @ np.stack([pose.position for pose in near]),
            quaternion_xyzw=product(from_rotation_vector(weights @ turns), unit_quaternion(reference)),
            covariance=noise + np.diag((ACCELERATIONS * bend) ** 2 / 3.0),
        )

    def _motion(self, stamp_ns: int) -> list[LensPose]:
        """The poses that describe the motion around a stamp, up to the first that follows it."""
        end = len(self._poses)
        while end > 1 and self._poses[end - 2].stamp_ns >= stamp_ns:
            end -= 1
        if end == 0:
            return []
        # Between two poses those two weigh most; beyond the last, more of them level the noise.
        wanted = 2 if self._poses[end - 1].stamp_ns >= stamp_ns else POSES
        motion = [self._poses[end - 1]]
        for index in range(end - 2, max(end - 1 - wanted, -1), -1):
            if motion[0].stamp_ns - self._poses[index].stamp_ns > self._longest_step_ns:
                break
            if motion[0].segment != self._poses[index].segment:
                break
            motion.insert(0, self._poses[index])
        return motion
