"""Source of bodies from geometry_msgs/PoseStamped topics, one per body.

natnet_ros2, vrpn_mocap and mocap_optitrack publish them. These drivers report neither validity nor the time
of exposure: the stamp is whatever they set, mostly the time of arrival.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from knee_gap_core.conversions.pose_messages import body_pose_from_message
from knee_gap_core.values.pose_interpolation import body_between
from knee_gap_core.values.poses import BodyPose, is_place, is_unit
from knee_gap_perception.trackers.body_source import BodyFrame, SourceStatus, Subscription
from knee_gap_perception.trackers.up_axis import position_z_up, quaternion_z_up

MOST_WAITING = 64


class PoseTopics:
    """Pairs the topics of the scope (the first name) and of other bodies into frames at the scope's stamps.

    Poses of the other bodies are taken with the very same stamp where there is one, and otherwise between
    their two poses around it, never beyond the last. A scope pose waits for them for at most `max_wait` [s]
    by the stamps that keep coming, and is then given without. `topics` are those of the bodies by their
    names. A `BodySource`.
    """

    waits = False

    def __init__(
        self,
        names: Sequence[str] = ("scope",),
        *,
        topics: Mapping[str, str] | None = None,
        up_axis: str = "z",
        max_wait: float = 0.05,
    ) -> None:
        self._topics = dict(topics or {})
        self._names = dict(enumerate(names, start=1))
        self._scope, *self._others = names
        self._up_axis = up_axis
        self._max_wait_ns = round(max_wait * 1e9)
        self._waiting: deque[BodyPose] = deque(maxlen=MOST_WAITING)
        self._recent: dict[str, deque[BodyPose]] = {name: deque(maxlen=MOST_WAITING) for name in self._others}
        self._counts = dict.fromkeys(names, 0)
        self._last_counts = dict(self._counts)

    @property
    def subscriptions(self) -> tuple[Subscription, ...]:
        """One topic a body."""
        return tuple(
            Subscription(topic, "geometry_msgs/msg/PoseStamped", partial(self.put, name))
            for name, topic in self._topics.items()
        )

    def put(self, name: str, message: Any) -> None:
        """Add a message of a body's topic."""
        raw = body_pose_from_message(message, name)
        body = BodyPose(
            stamp_ns=raw.stamp_ns,
            position=position_z_up(raw.position, self._up_axis),
            quaternion_xyzw=quaternion_z_up(raw.quaternion_xyzw, self._up_axis),
            name=name,
        )
        self._counts[name] += 1
        queue = self._waiting if name == self._scope else self._recent[name]
        if queue and body.stamp_ns < queue[-1].stamp_ns:
            # A bag that starts again: its end must not be paired with its beginning.
            queue.clear()
        queue.append(body)

    def poll(self, timeout: float = 0.0) -> list[BodyFrame]:
        """Return the frames that are complete, or have waited too long; never waits itself."""
        frames = []
        while self._waiting:
            scope = self._waiting[0]
            others = [self._at(name, scope.stamp_ns) for name in self._others]
            newest = max([self._waiting[-1].stamp_ns, *(q[-1].stamp_ns for q in self._recent.values() if q)])
            if None in others and newest - scope.stamp_ns <= self._max_wait_ns:
                break
            self._waiting.popleft()
            found = tuple(other for other in others if other is not None)
            frames.append(BodyFrame(scope.stamp_ns, (scope, *found), self._names))
        return frames

    def status(self) -> SourceStatus:
        """Return the status, with the topics without messages since the last call."""
        silent = [name for name, count in self._counts.items() if count == self._last_counts[name]]
        self._last_counts = dict(self._counts)
        words = f"no poses of {', '.join(silent)}: is the driver running, and its topic the right one?"
        return SourceStatus(not silent, words if silent else "poses come", dict(self._counts))

    def close(self) -> None:
        """Do nothing; there are no resources."""

    def _at(self, name: str, stamp_ns: int) -> BodyPose | None:
        poses = self._recent[name]
        before = next((pose for pose in reversed(poses) if pose.stamp_ns <= stamp_ns), None)
        if before is None or before.stamp_ns == stamp_ns:
            return before
        after = next((pose for pose in poses if pose.stamp_ns > stamp_ns), None)
        if after is None or after.stamp_ns - before.stamp_ns > self._max_wait_ns:
            return None
        return _between(before, after, stamp_ns)


def _between(before: BodyPose, after: BodyPose, stamp_ns: int) -> BodyPose | None:
    if not all(is_place(body.position) and is_unit(body.quaternion_xyzw) for body in (before, after)):
        return None
    return body_between(before, after, stamp_ns)
