"""tracking_node: poses of the tracked scope body in; scope_pose, the pose of the lens with its error, out."""

from collections.abc import Mapping, Sequence

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped

from knee_gap_node.base_node import RESULT_QOS, TRACKER_QOS, BaseNode, run
from knee_gap_perception.messages_tracking import body_pose_from_message, fill_lens_pose
from knee_gap_perception.pose_validity import ValidityParameters
from knee_gap_perception.poses import BodyPose, LensPose
from knee_gap_perception.tracking import ScopeTracker, TrackingParameters


class TrackingNode(BaseNode):
    """Converts, calls the tracker, publishes; a pose that is refused is not published at all."""

    def __init__(self) -> None:
        super().__init__("tracking_node", health=self.health)
        self._tracker = ScopeTracker(self.declare(TrackingParameters), self.declare(ValidityParameters))
        self.refuse_unknown_parameters()
        self._accepted_before = 0
        self._scope_pose = self.create_publisher(PoseWithCovarianceStamped, "scope_pose", RESULT_QOS)
        self.create_subscription(PoseStamped, "scope_body/pose", self.on_pose, TRACKER_QOS)

    def on_pose(self, message: PoseStamped) -> None:
        """Take a pose as a driver publishes it."""
        self.on_body(body_pose_from_message(message))

    def on_body(self, body: BodyPose) -> None:
        """Publish the lens pose of a body, or log why there is none."""
        lens = self._tracker.update(body)
        if isinstance(lens, LensPose):
            self._scope_pose.publish(fill_lens_pose(PoseWithCovarianceStamped(), lens))
        else:
            self.log_once(lens.reason, f"pose refused: {lens.detail}")

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """How many poses were accepted since the last time, and how many refused for which reason."""
        accepted = self._tracker.accepted_count - self._accepted_before
        self._accepted_before = self._tracker.accepted_count
        words = f"{accepted} poses in the last second" if accepted else "no pose accepted in the last second"
        refused = {f"refused: {reason}": count for reason, count in self._tracker.validity.counts.items()}
        return accepted > 0, words, {"accepted": self._tracker.accepted_count, **refused}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(TrackingNode, argv)
