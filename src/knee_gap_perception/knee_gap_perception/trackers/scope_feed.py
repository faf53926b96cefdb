"""Feed of the tracked scope from the configured source, with a diagnosis if there are no data."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.trackers.body_source import BodySource, SourceStatus, UnknownBodyError, choose_body
from knee_gap_perception.trackers.natnet.client import NatNetClient, NatNetParameters
from knee_gap_perception.trackers.pose_topic import PoseTopics
from knee_gap_perception.trackers.rigid_bodies import RigidBodiesTopic
from knee_gap_perception.trackers.up_axis import UP_AXES

# Name of the scope's body where each body has its own topic.
SCOPE = "scope"
SCOPE_TOPIC = "scope_body/pose"


class Setting(NamedTuple):
    """What a source is made from: topics of the bodies by their names, the scope's first, and the rest."""

    topics: Mapping[str, str]
    up_axis: str
    natnet: NatNetParameters | None
    ros_now: Callable[[], int]


class Source(NamedTuple):
    """A kind of source: how it is made, which axis points up if none is given, and how bodies are named.

    `own_names`: the scope is chosen by the name or id that the tracker gives it, not by its topic.
    """

    make: Callable[[Setting], BodySource]
    up_axis: str = "z"
    own_names: bool = True


# A new tracker is a module that makes a BodySource, and a row here.
SOURCES = {
    "pose": Source(
        lambda given: PoseTopics([*given.topics], topics=given.topics, up_axis=given.up_axis), own_names=False
    ),
    "rigid_bodies": Source(lambda given: RigidBodiesTopic(up_axis=given.up_axis)),
    "natnet": Source(lambda given: NatNetClient(given.natnet, given.ros_now, up_axis=given.up_axis), "y"),
}


@dataclass(frozen=True)
class SourceParameters:
    """Source of tracked bodies. Raises PerceptionError for values outside their choices."""

    source: str = field(
        default="pose",
        metadata={
            "description": "pose: geometry_msgs/PoseStamped, one topic per body; rigid_bodies: "
            "mocap4r2_msgs/RigidBodies; natnet: directly from Motive",
            "choices": tuple(SOURCES),
        },
    )
    body: str = field(
        default="",
        metadata={
            "description": "Rigid body of the scope, by name or streaming id, for rigid_bodies and natnet; "
            "empty: the only body"
        },
    )
    up_axis: str = field(
        default="auto",
        metadata={
            "description": "Axis that points up in the source's data; auto: y for natnet, Motive's default, "
            "and z for topics, as in REP-103",
            "choices": ("auto", *UP_AXES),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)

    def resolved_up_axis(self) -> str:
        """Return the axis that is meant."""
        return SOURCES[self.source].up_axis if self.up_axis == "auto" else self.up_axis


class ScopeFeed:
    """The scope's body and the others of its frame, from the source that the parameters name.

    `other_bodies` are the topics of other bodies by their names, for sources with a topic a body. Messages of
    the source's `subscriptions` are put into it by the node. Raises PerceptionError for an address that
    cannot be used.
    """

    def __init__(
        self,
        parameters: SourceParameters | None = None,
        natnet: NatNetParameters | None = None,
        *,
        other_bodies: Mapping[str, str] | None = None,
        ros_now: Callable[[], int] = time.time_ns,
    ) -> None:
        self.parameters = parameters or SourceParameters()
        kind = SOURCES[self.parameters.source]
        topics = {SCOPE: SCOPE_TOPIC, **(other_bodies or {})}
        self.source = kind.make(Setting(topics, self.parameters.resolved_up_axis(), natnet, ros_now))
        self._wanted = self.parameters.body if kind.own_names else SCOPE
        self._fault = ""

    def poll(self, timeout: float = 0.0) -> list[tuple[BodyPose, tuple[BodyPose, ...]]]:
        """Return the scope's body and the others of each new frame that contains the scope.

        Only a source that `waits` does, for at most `timeout` [s].
        """
        chosen = []
        for frame in self.source.poll(timeout):
            try:
                body, others = choose_body(frame, self._wanted)
            except UnknownBodyError as error:
                self._fault = str(error)
                continue
            self._fault = ""
            if body is not None:
                chosen.append((body, others))
        return chosen

    def status(self) -> SourceStatus:
        """Return the status of the source, and whether it has the wanted body."""
        status = self.source.status()
        if status.ok and self._fault:
            return SourceStatus(False, self._fault, status.values)
        return status

    def close(self) -> None:
        """Release the source's resources."""
        self.source.close()
