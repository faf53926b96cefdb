"""Poses of a lens whose scope is turned in its camera head, at the images whose notch shows by how much.

The tracker's poses come several times between two images, and how far the scope is turned is known at the
images alone. So there is one pose of the lens an image, at its stamp, from the tracked poses on either side
and the turn in that image itself: nothing is predicted, and an image without its notch has no pose.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from knee_gap_core.values.pose_interpolation import lens_between
from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation

LONGEST_AWAY_NS = 25_000_000  # from an image to the tracked pose on either side
KEPT = 512  # tracked poses: half a second of the fastest tracker, longer than an image is on its way
MOST_WAITING = 64  # images whose tracked poses have not come yet

NO_POSES = "the tracker has no pose close enough to the image"
OLD = "the image is older than the tracked poses that are kept"


class Tracked(NamedTuple):
    """The bodies of one accepted frame of the tracker, and its stamp by the images' clock."""

    stamp_ns: int
    body: BodyPose
    reference: BodyPose | None


class Without(NamedTuple):
    """The stamp of an image that has no pose of the lens, and why."""

    stamp_ns: int
    reason: str


class RotatedPoses:
    """Takes tracked bodies and sights of the notch, in the order of stamps; gives the poses at the sights.

    `lens_of` is the pose of the lens of tracked bodies at a notch's angle with its standard error [rad].
    """

    def __init__(self, lens_of: Callable[[Tracked, float, float], LensPose]) -> None:
        self._lens_of = lens_of
        self._tracked: deque[Tracked] = deque(maxlen=KEPT)
        self._observations: deque[NotchObservation] = deque(maxlen=MOST_WAITING)
        self._newest_observation_ns = 0

    def add_tracked(self, tracked: Tracked) -> None:
        """Take the bodies of the tracker's next frame; one from before the last clears the earlier ones."""
        if self._tracked and tracked.stamp_ns <= self._tracked[-1].stamp_ns:
            self.clear()
        self._tracked.append(tracked)

    def add_observation(self, observation: NotchObservation) -> None:
        """Take the notch of the next image; one from before the last clears the earlier ones."""
        if observation.stamp_ns <= self._newest_observation_ns:
            self._observations.clear()
        self._newest_observation_ns = observation.stamp_ns
        self._observations.append(observation)

    def clear(self) -> None:
        """Forget all that came."""
        self._tracked.clear()
        self._observations.clear()

    def ready(self) -> list[LensPose | Without]:
        """The poses at the images for which all is there, and why others have none."""
        reported: list[LensPose | Without] = []
        while self._observations:
            observation = self._observations[0]
            waits = not self._tracked or self._tracked[-1].stamp_ns < observation.stamp_ns
            if observation.seen and waits:
                break
            self._observations.popleft()
            reported.append(
                self._at(observation)
                if observation.seen
                else Without(observation.stamp_ns, observation.reason)
            )
        return reported

    def _at(self, observation: NotchObservation) -> LensPose | Without:
        stamp_ns, index = observation.stamp_ns, len(self._tracked) - 1
        while index > 0 and self._tracked[index - 1].stamp_ns >= stamp_ns:
            index -= 1
        after = self._tracked[index]
        if after.stamp_ns == stamp_ns:
            return self._lens_of(after, observation.angle, observation.angle_error)
        if index == 0:
            return Without(stamp_ns, OLD)
        before = self._tracked[index - 1]
        if max(stamp_ns - before.stamp_ns, after.stamp_ns - stamp_ns) > LONGEST_AWAY_NS:
            return Without(stamp_ns, NO_POSES)
        poses = [
            self._lens_of(tracked, observation.angle, observation.angle_error) for tracked in (before, after)
        ]
        return lens_between(poses[0], poses[1], stamp_ns)
