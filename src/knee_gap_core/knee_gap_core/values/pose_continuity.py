"""Continuity of lens poses: test whether they follow from each other as in a hand, with no unseen step.

A marker body that slips while the tracker does not see it comes back at another place with sound poses: no
pose is wrong, but the views before and after are no longer in one frame. So poses are numbered by segments.
Within a segment each pose follows from those before, and no track outlasts its segment.

A gap of a few periods is judged by the motion before it: a hand's acceleration is limited. After a longer gap
no such limit separates a hand's motion from a slip, and only a lens that is back where it was continues the
segment.
"""

from collections import deque
from collections.abc import Sequence
from math import atan2, hypot, inf, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Vector = tuple[float, float, float]

ACCELERATION = 2.0  # [m/s^2] four times the RMS of a hand's
ANGULAR_ACCELERATION = 40.0  # [rad/s^2] of a tremor of a degree at 6 Hz
TOLERANCE = 0.2e-3  # [m] beyond the poses' own errors
ANGULAR_TOLERANCE = 2.0e-3  # [rad]
MOST_UNKNOWN = 1.0e-3  # [m] by which acceleration may explain a deviation, however long the gap
MOST_UNKNOWN_ANGLE = 2.0e-2  # [rad]
SIGMAS = 4.0  # standard errors of a deviation that are not steps
MOTION_TIME_NS = 15_000_000  # over which the velocity before a gap is taken
# A pose that is lost costs two: the one after a gap of more than two periods is refused as well.
GAP_PERIODS = 4.25  # of the tracker, the longest gap over which its motion is extrapolated
SHORTEST_GAP_NS = 25_000_000  # that is taken for an occlusion, however fast the tracker
# A tracker slower than SHORTEST_GAP_NS shows its period by intervals in a row that are alike.
SLOWEST_PERIOD_NS = 100_000_000
ALIKE = 3  # intervals
ALIKE_RATIO = 1.25  # of the longest to the shortest
KEPT = 31  # poses


class _Pose(NamedTuple):
    """One pose, in floats because each frame is judged; variances are sums over the axes [m^2, rad^2]."""

    stamp_ns: int
    position: Sequence[float]
    quaternion_xyzw: Sequence[float]
    variance: float
    turn_variance: float


class PoseContinuity:
    """Numbers the segments of one stream of lens poses; take every accepted pose in the order of arrival."""

    def __init__(self) -> None:
        self.segment = 0
        # Why the present segment began, in words without numbers, to be counted; empty for the first.
        self.reason = ""
        self._frame_id = ""
        self._poses: deque[_Pose] = deque(maxlen=KEPT)
        self._intervals_ns: deque[int] = deque(maxlen=KEPT - 1)
        self._latest_ns: deque[int] = deque(maxlen=ALIKE)

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
        variances = [max(v, 0.0) for v in np.asarray(covariance, dtype=np.float64).reshape(36)[::7].tolist()]
        pose = _Pose(
            stamp_ns,
            np.asarray(position, dtype=np.float64).tolist(),
            np.asarray(quaternion_xyzw, dtype=np.float64).tolist(),
            sum(variances[:3]),
            sum(variances[3:]),
        )
        if self._poses:
            interval_ns = stamp_ns - self._poses[-1].stamp_ns
            if frame_id == self._frame_id and interval_ns == 0:
                return self.segment
            self._latest_ns.append(interval_ns)
            longest_ns = self._longest_gap_ns()
            if reason := self._break(pose, frame_id, longest_ns):
                self.segment, self.reason = self.segment + 1, reason
                self._poses.clear()
            elif interval_ns <= longest_ns:
                self._intervals_ns.append(interval_ns)
        self._frame_id = frame_id
        self._poses.append(pose)
        return self.segment

    def _break(self, pose: _Pose, frame_id: str, longest_ns: float) -> str:
        """Why a pose does not follow from the last, in words; empty if it does.

        `longest_ns`: the longest time between two poses that is no occlusion.
        """
        last = self._poses[-1]
        if frame_id != self._frame_id:
            return "the lens poses are given in another frame"
        if pose.stamp_ns < last.stamp_ns:
            return "the stamps of the lens poses run backwards"
        if pose.stamp_ns - last.stamp_ns > longest_ns:
            follows = _length(_shift(last, pose)) <= TOLERANCE + SIGMAS * sqrt(last.variance + pose.variance)
            follows = follows and _length(_turn(last, pose)) <= ANGULAR_TOLERANCE + SIGMAS * sqrt(
                last.turn_variance + pose.turn_variance
            )
            return "" if follows else "the lens came back elsewhere after the tracker had not seen it"
        return "" if self._follows(last, pose) else "the lens pose made a step that no hand makes"

    def _longest_gap_ns(self) -> float:
        """Longest time between two poses that is not an occlusion [ns]."""
        usual = median(self._intervals_ns) if self._intervals_ns else 0.0
        latest = self._latest_ns
        if len(latest) == ALIKE and 0 < max(latest) <= min(ALIKE_RATIO * min(latest), SLOWEST_PERIOD_NS):
            usual = max(usual, median(latest))
        return max(GAP_PERIODS * usual, SHORTEST_GAP_NS)

    def _follows(self, last: _Pose, pose: _Pose) -> bool:
        """Whether a pose continues the even motion before it, but for what a hand's acceleration bends."""
        earlier = self._earlier(last)
        if earlier is None:
            return True  # its motion is not known yet: speed is limited where poses are accepted
        since, before = (pose.stamp_ns - last.stamp_ns) / 1e9, (last.stamp_ns - earlier.stamp_ns) / 1e9
        share = since / before
        # An even acceleration a over both times bends the path by a/2 since (since + before).
        bend = 0.5 * since * (since + before)
        weights = ((1.0 + share) ** 2, share**2, 1.0)
        sigma = sqrt(sum(w * p.variance for w, p in zip(weights, (last, earlier, pose), strict=True)))
        turn_sigma = sqrt(
            sum(w * p.turn_variance for w, p in zip(weights, (last, earlier, pose), strict=True))
        )
        away = _difference(_shift(last, pose), _shift(earlier, last), share)
        turned_away = _difference(_turn(last, pose), _turn(earlier, last), share)
        limit = TOLERANCE + min(ACCELERATION * bend, MOST_UNKNOWN) + SIGMAS * sigma
        turn_limit = (
            ANGULAR_TOLERANCE + min(ANGULAR_ACCELERATION * bend, MOST_UNKNOWN_ANGLE) + SIGMAS * turn_sigma
        )
        return _length(away) <= limit and _length(turned_away) <= turn_limit

    def _earlier(self, last: _Pose) -> _Pose | None:
        """The latest pose that is MOTION_TIME before the last, or the first of the segment."""
        for pose in reversed(self._poses):
            if last.stamp_ns - pose.stamp_ns >= MOTION_TIME_NS:
                return pose
        first = self._poses[0]
        return first if first is not last else None


def _shift(before: _Pose, after: _Pose) -> Vector:
    """From one position to another [m]."""
    (a, b, c), (x, y, z) = before.position, after.position
    return x - a, y - b, z - c


def _turn(before: _Pose, after: _Pose) -> Vector:
    """Rotation vector [rad] in the fixed frame from one rotation to another, the shorter way round."""
    (a, b, c, d), (x, y, z, w) = before.quaternion_xyzw, after.quaternion_xyzw
    # after times the conjugate of before
    real = w * d + x * a + y * b + z * c
    imaginary = (
        x * d - w * a - y * c + z * b,
        y * d - w * b - z * a + x * c,
        z * d - w * c - x * b + y * a,
    )
    length = hypot(*imaginary)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    factor = 2.0 * atan2(length, abs(real)) / length * (1.0 if real >= 0.0 else -1.0)
    return factor * imaginary[0], factor * imaginary[1], factor * imaginary[2]


def _difference(minuend: Vector, subtrahend: Vector, factor: float) -> Vector:
    """`minuend` less `factor` times `subtrahend`."""
    (x, y, z), (a, b, c) = minuend, subtrahend
    return x - factor * a, y - factor * b, z - factor * c


def _length(vector: Vector) -> float:
    """Length of a vector; infinite if it is not a number."""
    length = hypot(*vector)
    return length if length == length else inf
