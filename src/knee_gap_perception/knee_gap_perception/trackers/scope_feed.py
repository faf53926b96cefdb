"""Feed of the tracked scope from the configured source, with a diagnosis if there are no data."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.trackers.body_source import BodySource, SourceStatus, UnknownBodyError, choose_body
from knee_gap_perception.trackers.natnet.client import NatNetClient, NatNetParameters
from knee_gap_perception.trackers.pose_topic import PoseTopics
from knee_gap_perception.trackers.rigid_bodies import RigidBodiesTopic
from knee_gap_perception.trackers.up_axis import UP_AXES

SOURCES = ("pose", "rigid_bodies", "natnet")
# Name of the scope's body if each body has its own topic.
SCOPE = "scope"


@dataclass(frozen=True)
class SourceParameters:
    """Source of tracked bodies. Raises PerceptionError for values outside their choices."""

    source: str = field(
        default="pose",
        metadata={
            "description": "pose: geometry_msgs/PoseStamped, one topic per body; rigid_bodies: "
            "mocap4r2_msgs/RigidBodies; natnet: directly from Motive",
            "choices": SOURCES,
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
        """Return the up axis that applies."""
        if self.up_axis != "auto":
            return self.up_axis
        return "y" if self.source == "natnet" else "z"


class ScopeFeed:
    """The scope's body and the others of its frame, from the source that the parameters name.

    The node adds messages of topics to `source`; NatNet is received here. Raises PerceptionError for an
    address that cannot be used.
    """

    def __init__(
        self,
        parameters: SourceParameters | None = None,
        natnet: NatNetParameters | None = None,
        *,
        other_bodies: Sequence[str] = (),
        ros_now: Callable[[], int] = time.time_ns,
    ) -> None:
        self.parameters = parameters or SourceParameters()
        up_axis = self.parameters.resolved_up_axis()
        self.source: BodySource
        self._wanted = self.parameters.body
        if self.parameters.source == "natnet":
            self.source = NatNetClient(natnet, ros_now, up_axis=up_axis)
        elif self.parameters.source == "rigid_bodies":
            self.source = RigidBodiesTopic(up_axis=up_axis)
        else:
            self.source = PoseTopics([SCOPE, *other_bodies], up_axis=up_axis)
            self._wanted = SCOPE
        self._fault = ""

    def poll(self, timeout: float = 0.0) -> list[tuple[BodyPose, tuple[BodyPose, ...]]]:
        """Return the scope's body and the others of each new frame that contains the scope.

        Only NatNet waits, for at most `timeout` [s].
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
