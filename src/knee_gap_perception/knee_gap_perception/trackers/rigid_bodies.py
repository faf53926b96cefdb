"""Source of bodies from mocap4r2_msgs/RigidBodies, by field name, for any message class.

A body that is not tracked is missing from the message or repeats its last pose; there is no valid bit.
"""

from collections import deque
from typing import Any

import numpy as np

from knee_gap_core.values.poses import BodyPose
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_perception.trackers.body_source import BodyFrame, SourceStatus, Subscription
from knee_gap_perception.trackers.up_axis import position_z_up, quaternion_z_up

MOST_WAITING = 64


class RigidBodiesTopic:
    """Frames of a RigidBodies topic; a `BodySource`. A name that is a number is a streaming id."""

    waits = False

    def __init__(self, *, up_axis: str = "z") -> None:
        self._up_axis = up_axis
        self._frames: deque[BodyFrame] = deque(maxlen=MOST_WAITING)
        self._names: dict[int, str] = {}
        self._count = 0
        self._last_count = 0

    @property
    def subscriptions(self) -> tuple[Subscription, ...]:
        """One topic with all bodies."""
        return (Subscription("rigid_bodies", "mocap4r2_msgs/msg/RigidBodies", self.put),)

    def put(self, message: Any) -> None:
        """Add a message."""
        self._count += 1
        stamp = stamp_ns(message.header)
        bodies = tuple(self._body(item, stamp) for item in message.rigidbodies)
        known = set(self._names.values())
        for body in bodies:
            if body.name not in known:
                self._names[self._number(body.name)] = body.name
        self._frames.append(BodyFrame(stamp, bodies, dict(self._names)))

    def poll(self, timeout: float = 0.0) -> list[BodyFrame]:
        """Return the frames since the last call; never waits itself."""
        frames = list(self._frames)
        self._frames.clear()
        return frames

    def status(self) -> SourceStatus:
        """Return the status: whether messages arrived since the last call."""
        came = self._count - self._last_count
        self._last_count = self._count
        words = (
            "rigid bodies received"
            if came
            else "no rigid bodies: is the driver running and the topic the right one?"
        )
        return SourceStatus(came > 0, words, {"messages": self._count})

    def close(self) -> None:
        """Do nothing; there are no resources."""

    def _body(self, item: Any, stamp_ns: int) -> BodyPose:
        place, turn = item.pose.position, item.pose.orientation
        return BodyPose(
            stamp_ns=stamp_ns,
            position=position_z_up(np.array([place.x, place.y, place.z], dtype=np.float64), self._up_axis),
            quaternion_xyzw=quaternion_z_up(
                np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64), self._up_axis
            ),
            name=str(item.rigid_body_name),
        )

    def _number(self, name: str) -> int:
        """The streaming id, which drivers give as the name; else a free number."""
        if name.isdecimal() and int(name) not in self._names:
            return int(name)
        return max(self._names, default=0) + 1
