"""The core of tracking_node: tracked bodies and the notch in; lens poses and the scope's rotation out."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

from knee_gap_core.conversions.pose_messages import fill_lens_pose, fill_transform
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Blank, Health, InputTopic, Notice, Outcome, Output, OutputTopic, Qos
from knee_gap_core.values.poses import BodyPose, FramePose, LensPose
from knee_gap_perception.calibration.in_use import CalibrationParameters, hash_or_none
from knee_gap_perception.camera.medium import Medium
from knee_gap_perception.messages_tracking import (
    fill_scope_calibration,
    fill_scope_rotation,
    notch_from_message,
)
from knee_gap_perception.scope_pose.frame_tree import FrameParameters, FrameTree
from knee_gap_perception.scope_pose.pose_validity import Refusal, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.trackers.natnet.client import NatNetParameters
from knee_gap_perception.trackers.scope_feed import ScopeFeed, SourceParameters

NODE = "tracking_node"
SCOPE_NOTCH = InputTopic("scope_notch", "knee_gap_msgs/msg/ScopeNotch", Qos.RESULT)
SCOPE_POSE = OutputTopic("scope_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", Qos.RESULT)
CALIBRATION = OutputTopic(
    "scope_calibration", "knee_gap_msgs/msg/ScopeCalibration", Qos.LATCHED, optional=True
)
SCOPE_ROTATION = OutputTopic("scope_rotation", "knee_gap_msgs/msg/ScopeRotation", Qos.RESULT, optional=True)
# Frames, not a result of the measurement: broadcast by a live node only.
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = OutputTopic("/tf", "tf2_msgs/msg/TFMessage", Qos.RESULT, optional=True)

# A frame of the tracker that contains the scope: its body and the others.
Frame = tuple[BodyPose, tuple[BodyPose, ...]]


class TrackingCore:
    """Turns messages and frames into those that tracking_node publishes, by a `ScopeTracker`.

    The scope is used in `medium`; None: in that of its calibration. A source that waits for frames is asked
    by `poll`, in a thread of its own; its frames are handed to `take_frame`.
    """

    parameters: tuple[type, ...] = (
        TrackingParameters,
        ValidityParameters,
        CalibrationParameters,
        SourceParameters,
        NatNetParameters,
    )

    @classmethod
    def from_parameters(
        cls, given: Sequence[Any], blank: Blank, *, ros_now: Callable[[], int] = time.time_ns
    ) -> Self:
        """A core with one instance of each of `parameters`. Raises PerceptionError for unusable ones.

        `ros_now` is the clock [ns] to which NatNet's exposure times are mapped.
        """
        tracking, validity, calibration, source, natnet = given
        tracker = ScopeTracker(
            tracking, validity, calibration.load(), by_notch=calibration.scope_rotation_notch
        )
        feed = ScopeFeed(source, natnet, other_bodies=tracking.other_bodies, ros_now=ros_now)
        return cls(tracker, feed, blank, medium=calibration.used_in)

    def __init__(
        self, tracker: ScopeTracker, feed: ScopeFeed, blank: Blank, *, medium: Medium | None = None
    ) -> None:
        self.tracker = tracker
        self.feed = feed
        self._blank = blank
        self._medium = medium
        self._put = {one.topic: one.put for one in feed.source.subscriptions}
        self._frames: FrameTree | None = None
        self._frames_wanted: Callable[[], bool] = lambda: False
        self._accepted_before = 0
        # Rejected poses since the last report of the health, and the reason of the last one.
        self._refused, self._why_refused = 0, ""
        # Whether the source delivered data at the last report.
        self.source_works = False

    @property
    def inputs(self) -> tuple[InputTopic, ...]:
        """The notch, if it is followed, and the topics of the source, if it has any."""
        bodies = (
            InputTopic(one.topic, one.msgtype, Qos.TRACKER, from_driver=True, needed=True)
            for one in self.feed.source.subscriptions
        )
        return (*([SCOPE_NOTCH] if self.tracker.by_notch else []), *bodies)

    @property
    def outputs(self) -> tuple[OutputTopic, ...]:
        """The rotation of the scope is published if it is tracked."""
        return (
            SCOPE_POSE,
            CALIBRATION,
            *([SCOPE_ROTATION] if self.tracker.follows_rotation else []),
            *([TRANSFORMS] if self._frames else []),
        )

    def broadcast_frames(self, parameters: FrameParameters, wanted: Callable[[], bool]) -> None:
        """Return the frames of the scope for /tf as well from now on, while they are wanted.

        Raises PerceptionError if two frames have one name.
        """
        self._frames, self._frames_wanted = FrameTree(parameters, self.tracker), wanted

    def begin(self, now_ns: int) -> list[Outcome]:
        """The calibration in use."""
        message = fill_scope_calibration(
            self._blank(CALIBRATION.msgtype),
            NODE,
            self.tracker.calibration,
            rotation_followed=self.tracker.follows_rotation,
            medium=self._medium,
        )
        return [Output(CALIBRATION.topic, message, now_ns)]

    def take(self, topic: str, message: Any, now_ns: int, queued_ns: int = 0) -> list[Outcome]:
        """Receive the notch of an image, or a message of the source."""
        if topic == SCOPE_NOTCH.topic:
            return list(self._reported(self.tracker.take_notch(notch_from_message(message))))
        self._put[topic](message)
        return [one for frame in self.poll(0.0) for one in self.take_frame(frame)]

    def poll(self, timeout: float) -> list[Frame]:
        """Frames of the source since the last call; one that waits does so for at most `timeout` [s]."""
        return self.feed.poll(timeout)

    def take_frame(self, frame: Frame) -> list[Outcome]:
        """Receive a frame of the tracker; return the lens poses that follow from it."""
        return list(self._reported(self.tracker.take(*frame)))

    def ready(self, now_ns: int) -> list[Outcome]:
        """Nothing: no pose waits for time to pass."""
        return []

    def finish(self, now_ns: int) -> list[Outcome]:
        """Nothing: what waits for a second pose has none without it."""
        return []

    def recover(self, fault: Fault) -> list[Outcome]:
        """Reset the tracker; the pose that raised is not published."""
        self.tracker.reset()
        self._note_refused(fault.reason)
        return []

    def health(self) -> Health:
        """Status of the source, and poses accepted and rejected since the last report."""
        accepted = self.tracker.accepted_count - self._accepted_before
        self._accepted_before = self.tracker.accepted_count
        source = self.feed.status()
        self.source_works = source.ok
        words = f"{accepted} poses in the last second" if source.ok else source.words
        if source.ok and not accepted and self.tracker.notch_flaw:
            words = self.tracker.notch_flaw
        elif source.ok and self._refused:
            words += f", {self._refused} rejected: {self._why_refused}"
        self._refused = 0
        rows: dict[str, object] = {
            "calibration": hash_or_none(self.tracker.calibration),
            "accepted": self.tracker.accepted_count,
            **source.values,
            **{f"refused: {why}": count for why, count in dict(self.tracker.validity.counts).items()},
        }
        if self.tracker.follows_rotation:
            rows["turn of the scope [rad]"] = self.tracker.turn
        return source.ok and accepted > 0, words, rows

    def _note_refused(self, why: str) -> None:
        self._refused, self._why_refused = self._refused + 1, why

    def _reported(self, lenses: Sequence[LensPose | Refusal]) -> Iterator[Outcome]:
        """Poses of the lens, each after the rotation at it, or why there are none."""
        for lens in lenses:
            if not isinstance(lens, LensPose):
                self._note_refused(lens.detail)
                yield Notice(lens.reason, f"pose rejected: {lens.detail}")
                continue
            if self.tracker.follows_rotation:
                rotation = fill_scope_rotation(self._blank(SCOPE_ROTATION.msgtype), lens)
                yield Output(SCOPE_ROTATION.topic, rotation, lens.stamp_ns)
            pose = fill_lens_pose(self._blank(SCOPE_POSE.msgtype), lens)
            yield Output(SCOPE_POSE.topic, pose, lens.stamp_ns)
        if self._frames is not None and self._frames_wanted():
            yield from self._transforms(self._frames.frames(lenses))

    def _transforms(self, frames: Sequence[FramePose]) -> Iterator[Outcome]:
        if frames:
            message = self._blank(TRANSFORMS.msgtype)
            message.transforms = [fill_transform(self._blank(TRANSFORM), frame) for frame in frames]
            yield Output(TRANSFORMS.topic, message, frames[-1].stamp_ns)
