"""The frames of the scope as /tf has them: from the tracker's frame to the tracked body to the lens.

With a reference body they hang below that body, which hangs below the tracker's frame.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import FramePose, LensPose
from knee_gap_core.values.rigid_transforms import inverse, quaternion_xyzw
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.pose_validity import Refusal
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker


@dataclass(frozen=True)
class FrameParameters:
    """What tracking_node broadcasts on /tf."""

    publish_tf: bool = field(
        default=True,
        metadata={
            "description": "Broadcast frame_id -> (reference_body ->) body_frame_id -> child_frame_id on "
            "/tf; the frames of two scopes need different names"
        },
    )
    body_frame_id: str = field(
        default="scope_body", metadata={"description": "Name of the tracked body's frame on /tf"}
    )


class FrameTree:
    """Makes the frames that belong to each pose of the lens.

    Raises PerceptionError if two frames have one name, or one has none.
    """

    def __init__(self, parameters: FrameParameters, tracker: ScopeTracker) -> None:
        self._body_frame_id = parameters.body_frame_id
        self._tracker = tracker
        self._reference_ns: int | None = None
        scope = tracker.parameters
        names = [scope.frame_id, parameters.body_frame_id, scope.child_frame_id]
        names += [scope.reference_body] if scope.reference_body else []
        if len(set(names)) < len(names) or not all(names):
            raise PerceptionError(
                f"the frames on /tf need names of their own, not {', '.join(repr(name) for name in names)}: "
                "change frame_id, body_frame_id or child_frame_id, or set publish_tf to false"
            )

    def frames(self, lenses: Iterable[LensPose | Refusal]) -> list[FramePose]:
        """The frames at the poses of the lens that were just published, and the reference body's, if new."""
        frames = self._reference()
        for lens in lenses:
            if not isinstance(lens, LensPose):
                continue
            # From the lens, so that the chain ends exactly where scope_pose is, also between two frames
            # of the tracker.
            T_body_lens = self._tracker.body_to_lens(lens.scope_rotation)
            T_frame_body = lens.matrix() @ inverse(T_body_lens)
            body, optical = self._body_frame_id, lens.child_frame_id
            frames += [
                _frame_pose(lens.stamp_ns, lens.frame_id, body, T_frame_body),
                _frame_pose(lens.stamp_ns, body, optical, T_body_lens),
            ]
        return frames

    def _reference(self) -> list[FramePose]:
        latest = self._tracker.latest
        if latest is None or latest.reference is None or latest.stamp_ns == self._reference_ns:
            return []
        self._reference_ns = latest.stamp_ns
        parameters, reference = self._tracker.parameters, latest.reference
        return [
            FramePose(
                latest.stamp_ns,
                parameters.frame_id,
                parameters.reference_body,
                reference.position,
                reference.quaternion_xyzw,
            )
        ]


def _frame_pose(stamp_ns: int, frame_id: str, child_frame_id: str, T_frame_child: Array) -> FramePose:
    return FramePose(stamp_ns, frame_id, child_frame_id, T_frame_child[:3, 3], quaternion_xyzw(T_frame_child))
