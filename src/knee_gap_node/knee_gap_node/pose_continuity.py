"""Whether the poses of a lens follow from each other as those of a hand do, with no unseen step between.

A marker body that slips while nobody sees it comes back at another place with poses that are all sound.
Nothing in those poses is wrong, only the views before and after are no longer of one frame. So poses are
numbered by segments: within one each pose follows from those before it, and no track outlasts its segment.

A gap of a few periods is judged by the motion before it: no hand accelerates faster than `ACCELERATION`. After
a longer one no such limit tells a hand's motion from a slip, and only a lens that is back where it was goes on.
"""

from collections import deque
from dataclasses import dataclass
from statistics import median

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

ACCELERATION = 2.0  # [m/s^2] four times the RMS of a hand's
ANGULAR_ACCELERATION = 8.0  # [rad/s^2] the same for its rotation
TOLERANCE = 0.2e-3  # [m] beyond the poses' own errors
ANGULAR_TOLERANCE = 2.0e-3  # [rad]
MOST_UNKNOWN = 1.0e-3  # [m] by which acceleration may explain a deviation, however long the gap
MOST_UNKNOWN_ANGLE = 2.0e-2  # [rad]
SIGMAS = 4.0  # standard errors of a deviation that are no step
MOTION_TIME_NS = 15_000_000  # over which the velocity before a gap is taken
# A pose that is lost costs two: the one after a gap of more than two periods is refused as well.
GAP_PERIODS = 4.25  # of the tracker, the longest gap over which its motion is extrapolated
SHORTEST_GAP_NS = 25_000_000  # that is taken for an occlusion, however fast the tracker
KEPT = 31  # poses


@dataclass(frozen=True, eq=False)
class _Pose:
    stamp_ns: int
    position: Array
    rotation: Rotation
    variances: Array  # (2,) sum of the variances of position [m^2] and of rotation [rad^2]


class PoseContinuity:
    """Numbers the segments of one stream of lens poses; take every accepted pose in the order of arrival."""

    def __init__(self) -> None:
        self.segment = 0
        # Why the present segment began, in words without numbers, to be counted; empty for the first.
        self.reason = ""
        self._frame_id = ""
        self._poses: deque[_Pose] = deque(maxlen=KEPT)

    def take(
        self,
        stamp_ns: int,
        frame_id: str,
        position: npt.ArrayLike,
        quaternion_xyzw: npt.ArrayLike,
        covariance: npt.ArrayLike,
    ) -> int:
        """Number of the segment that a pose belongs to; a new one if the pose does not follow from the last.

        `position` (3,) [m], `quaternion_xyzw` (4,) of about unit length and `covariance` (6, 6) [m^2, rad^2]
        are those of geometry_msgs/PoseWithCovarianceStamped, and finite. Another frame and a stamp before the
        last begin a segment as well; a stamp that comes twice is left out.
        """
        variances = np.diag(np.asarray(covariance, dtype=np.float64).reshape(6, 6)).reshape(2, 3)
        pose = _Pose(
            stamp_ns,
            np.asarray(position, dtype=np.float64),
            Rotation.from_quat(np.asarray(quaternion_xyzw, dtype=np.float64)),
            np.maximum(variances, 0.0).sum(axis=1),
        )
        if self._poses:
            if frame_id == self._frame_id and stamp_ns == self._poses[-1].stamp_ns:
                return self.segment
            if reason := self._break(pose, frame_id):
                self.segment, self.reason = self.segment + 1, reason
                self._poses.clear()
        self._frame_id = frame_id
        self._poses.append(pose)
        return self.segment

    def _break(self, pose: _Pose, frame_id: str) -> str:
        """Why a pose does not follow from the last, in words; empty if it does."""
        last = self._poses[-1]
        if frame_id != self._frame_id:
            return "the lens poses are given in another frame"
        if pose.stamp_ns < last.stamp_ns:
            return "the stamps of the lens poses run backwards"
        with np.errstate(all="ignore"):
            if pose.stamp_ns - last.stamp_ns > self._longest_gap_ns():
                follows = _within(_between(last, pose), last.variances + pose.variances, np.zeros(2))
                return "" if follows else "the lens came back elsewhere after the tracker had not seen it"
            return "" if self._follows(last, pose) else "the lens pose made a step that no hand makes"

    def _longest_gap_ns(self) -> float:
        """Longest time between two poses that is no occlusion [ns]."""
        stamps = [pose.stamp_ns for pose in self._poses]
        intervals = [after - before for before, after in zip(stamps, stamps[1:], strict=False)]
        return max(GAP_PERIODS * median(intervals), SHORTEST_GAP_NS) if intervals else SHORTEST_GAP_NS

    def _follows(self, last: _Pose, pose: _Pose) -> bool:
        """Whether a pose lies where the even motion before it leads, within what a hand's acceleration bends."""
        earlier = self._earlier(last)
        if earlier is None:
            return True  # its motion is not known yet: speed is limited where poses are accepted
        since, before = (pose.stamp_ns - last.stamp_ns) / 1e9, (last.stamp_ns - earlier.stamp_ns) / 1e9
        share = since / before
        # An even acceleration a over both times bends the path by a/2 since (since + before).
        bend = 0.5 * since * (since + before) * np.array([ACCELERATION, ANGULAR_ACCELERATION])
        unknown = np.minimum(bend, [MOST_UNKNOWN, MOST_UNKNOWN_ANGLE])
        variances = (1.0 + share) ** 2 * last.variances + share**2 * earlier.variances + pose.variances
        away = _between(last, pose) - share * _between(earlier, last)
        return _within(away, variances, unknown)

    def _earlier(self, last: _Pose) -> _Pose | None:
        """The latest pose that is MOTION_TIME before the last, or the first of the segment."""
        for pose in reversed(self._poses):
            if last.stamp_ns - pose.stamp_ns >= MOTION_TIME_NS:
                return pose
        first = self._poses[0]
        return first if first is not last else None


def _between(before: _Pose, after: _Pose) -> Array:
    """Motion (6,) from one pose to another: shift [m] and rotation vector [rad] in the fixed frame."""
    turn = (after.rotation * before.rotation.inv()).as_rotvec()
    return np.concatenate([after.position - before.position, turn])


def _within(away: Array, variances: Array, unknown: Array) -> bool:
    """Whether a deviation (6,) is within tolerance, its errors' variances (2,) and what is unknown (2,)."""
    lengths = np.hypot(np.hypot(away[[0, 3]], away[[1, 4]]), away[[2, 5]])
    limits = np.array([TOLERANCE, ANGULAR_TOLERANCE]) + unknown + SIGMAS * np.sqrt(variances)
    return bool((lengths <= limits).all())
