"""Lens poses kept for a short while, and the pose at the moment of an image, between two of them."""

from bisect import bisect_left
from collections import deque
from dataclasses import replace
from enum import StrEnum
from math import isfinite

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import BadInputError
from knee_gap_core.values.pose_continuity import PoseContinuity
from knee_gap_core.values.pose_interpolation import lens_between
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.quaternions import turn_from

# Over which the velocity is taken [ns]. The tracker's noise on it falls with this time, but the older it is,
# the more a hand's has changed: 0.0367 mm over 17 ms are 3 mm/s, as are 0.5 m/s^2 in 6 ms.
MOTION_TIME_NS = 20_000_000
# A tracker that measures does not give the same numbers to the last bit so often in a row.
FROZEN_REPEATS = 10


class PoseRefusal(StrEnum):
    """Why a pose is not kept, or why there is none at a stamp."""

    NOT_FINITE = "the lens pose has numbers that are NaN or infinite"
    NO_ERROR = "the lens pose's covariance is 0, which means unknown, or is not a covariance"
    NOT_UNIT = "the lens pose's quaternion is not of length 1"
    DUPLICATE = "the lens pose has the stamp of the one before it"
    FROZEN = "the lens pose repeats an old one bit by bit under new stamps"
    NOT_YET = "no lens pose follows the stamp yet"
    TOO_OLD = "the stamp is before the first lens pose that is kept"
    GAP = "a lens pose around the stamp is further from it than max_pose_age"
    DISCONTINUOUS = "the lens pose made a step, or was lost, around the image"


class PoseBuffer:
    """The latest poses of the lens, in the order of their stamps; interpolates between two, never beyond one.

    `max_pose_age` [s] is the longest time between the stamp asked for and either of its two poses; `capacity`
    the number of poses kept. Between poses the lens does not move evenly: `acceleration` [m/s^2] and
    `angular_acceleration` [rad/s^2] are the RMS lengths of a hand's, whose effect on the interpolated pose
    its covariance includes. `needs_error`: a pose without a covariance is refused.

    Raises BadInputError for settings outside their range.
    """

    def __init__(
        self,
        max_pose_age: float = 0.05,
        *,
        capacity: int = 2048,
        acceleration: float = 0.5,
        angular_acceleration: float = 2.0,
        needs_error: bool = True,
    ) -> None:
        if not 0.0 < max_pose_age < 10.0:
            raise BadInputError(f"max_pose_age must lie in (0, 10) s, not {max_pose_age}")
        if capacity < 2:
            raise BadInputError(f"the pose buffer must keep at least 2 poses, not {capacity}")
        for name, value in (("acceleration", acceleration), ("angular_acceleration", angular_acceleration)):
            if not (value >= 0.0 and isfinite(value)):
                raise BadInputError(f"{name} must be finite and not negative, not {value}")
        self.max_pose_age = max_pose_age
        self._needs_error = needs_error
        self.reset_count = 0
        # Poses in a row that repeated the one before them.
        self._repeats = 0
        self._acceleration = acceleration
        self._angular_acceleration = angular_acceleration
        self._poses: deque[LensPose] = deque(maxlen=capacity)
        # Goes on counting when the buffer is emptied: poses after that are not continuous with those before.
        self._continuity = PoseContinuity()

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def discontinuity(self) -> str:
        """Why the segment of the newest pose began, in constant words; empty for the first."""
        return self._continuity.reason

    @property
    def newest_stamp_ns(self) -> int | None:
        """Stamp of the newest pose; None while empty."""
        return self._poses[-1].stamp_ns if self._poses else None

    def clear(self) -> None:
        """Forget all poses."""
        self._poses.clear()

    def add(self, pose: LensPose) -> PoseRefusal | None:
        """Keep a pose, or return why not.

        A stamp before the newest one (a bag that starts again) or another frame empties the buffer first. A
        pose that repeats the one before it to the last bit is not a measurement, whatever its stamp.
        """
        if refusal := _refusal(pose):
            return refusal
        if self._needs_error and not _has_error(pose):
            return PoseRefusal.NO_ERROR
        if self._poses:
            newest = self._poses[-1]
            if pose.frame_id == newest.frame_id and pose.stamp_ns == newest.stamp_ns:
                return PoseRefusal.DUPLICATE
            if pose.frame_id != newest.frame_id or pose.stamp_ns < newest.stamp_ns:
                self.clear()
                self.reset_count += 1
        self._repeats = self._repeats + 1 if self._poses and _same_place(pose, self._poses[-1]) else 0
        if self._repeats >= FROZEN_REPEATS:
            return PoseRefusal.FROZEN
        segment = self._continuity.take(
            pose.stamp_ns, pose.frame_id, pose.position, pose.quaternion_xyzw, pose.covariance
        )
        self._poses.append(replace(pose, segment=segment))
        return None

    def at(self, stamp_ns: int) -> LensPose | PoseRefusal:
        """Return the pose at a stamp, or why there is none; positions linearly, rotations by slerp."""
        if not self._poses or stamp_ns > self._poses[-1].stamp_ns:
            return PoseRefusal.NOT_YET
        if stamp_ns < self._poses[0].stamp_ns:
            return PoseRefusal.TOO_OLD
        index = bisect_left(self._poses, stamp_ns, key=lambda pose: pose.stamp_ns)
        after = self._poses[index]
        if after.stamp_ns == stamp_ns:
            around = self._near(index)
            return replace(after, motion=_motion(around, after), motion_time=_seconds(around, after))
        before = self._poses[index - 1]
        age = round(self.max_pose_age * 1e9)
        if stamp_ns - before.stamp_ns > age or after.stamp_ns - stamp_ns > age:
            return PoseRefusal.GAP
        if before.segment != after.segment:
            return PoseRefusal.DISCONTINUOUS
        earlier = self._before(index)
        between = lens_between(before, after, stamp_ns, self._acceleration, self._angular_acceleration)
        return replace(between, motion=_motion(earlier, after), motion_time=_seconds(earlier, after))

    def _before(self, index: int) -> LensPose:
        """The earliest pose within MOTION_TIME before that of an index, at least the one before it.

        Of the same segment: a step is not a velocity.
        """
        start, segment = self._poses[index].stamp_ns - MOTION_TIME_NS, self._poses[index].segment
        found = min(bisect_left(self._poses, start, key=lambda pose: pose.stamp_ns), index - 1)
        while found < index - 1 and self._poses[found].segment != segment:
            found += 1
        return self._poses[found]

    def _near(self, index: int) -> LensPose:
        """The pose that gives the velocity at that of an index, before or after it; itself if none is near.

        They are at most as far apart as the two around a stamp may be.
        """
        pose, longest_ns = self._poses[index], 2 * round(self.max_pose_age * 1e9)
        others = [self._before(index)] if index else []
        if index + 1 < len(self._poses):
            others.append(self._poses[index + 1])
        near = (
            other
            for other in others
            if abs(other.stamp_ns - pose.stamp_ns) <= longest_ns and other.segment == pose.segment
        )
        return next(near, pose)


def _motion(one: LensPose, other: LensPose) -> Array:
    """Velocity and turning (6,) between two poses; NaN between a pose and itself."""
    if one is other:
        return np.full(6, np.nan)
    turn = turn_from(one.quaternion_xyzw, other.quaternion_xyzw)
    moved = np.concatenate([other.position - one.position, turn])
    return np.asarray(moved / ((other.stamp_ns - one.stamp_ns) / 1e9))


def _seconds(one: LensPose, other: LensPose) -> float:
    """The time between two poses; infinite between a pose and itself."""
    return abs(other.stamp_ns - one.stamp_ns) / 1e9 if one is not other else np.inf


def _same_place(pose: LensPose, other: LensPose) -> bool:
    return bool(
        np.array_equal(pose.position, other.position)
        and np.array_equal(pose.quaternion_xyzw, other.quaternion_xyzw)
    )


def _refusal(pose: LensPose) -> PoseRefusal | None:
    numbers = np.concatenate([pose.position, pose.quaternion_xyzw, np.ravel(pose.covariance)])
    if not np.isfinite(numbers).all():
        return PoseRefusal.NOT_FINITE
    if abs(float(np.linalg.norm(pose.quaternion_xyzw)) - 1.0) > 1e-3:
        return PoseRefusal.NOT_UNIT
    return None


def _has_error(pose: LensPose) -> bool:
    """Whether a pose states its error: zeros are the message's default, and no tracker is perfect."""
    variances = np.diag(pose.covariance)
    return bool(np.all(variances[:3] > 0.0) and np.all(variances[3:] >= 0.0))
