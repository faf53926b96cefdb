"""The images and lens poses of one scope, as messages, to the edges in each image: segmentation_node but ROS.

An image may wait a little for the lens pose that follows it, so that the pose at its stamp is interpolated
and not predicted. It waits for nothing else, and not where no pose is to be expected.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import nan
from typing import Any, NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.pose_interpolation import LensPosePredictor
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.camera.agreement import disagreement
from knee_gap_perception.camera.bearing_errors import BearingErrors
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.camera_errors import CameraErrors, ErrorSource
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.camera.medium import AIR, SALINE, Medium
from knee_gap_perception.camera.refraction import camera_in_medium
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.edge_tracking.overlay import draw_overlay
from knee_gap_perception.edge_tracking.parameters import PoseParameters
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.messages import (
    checked_lens_pose,
    image_from_compressed,
    image_from_message,
    refuse_stamp,
)
from knee_gap_perception.scope_rotation.notch_tracker import NotchFollower, NotchObservation

NO_CAMERA = "no camera_info received yet"
# At 60 Hz and the longest wait no more images wait than these; of a faster camera the oldest waits no longer.
MOST_WAITING = 8
# With one lens pose an image, the longest time between two: of 10 images a second.
LONGEST_FRAME_NS = 100_000_000


class _Waiting(NamedTuple):
    """An image that waits for a lens pose, and when it arrived [ns].

    `image` where it was looked at already; `expects_pose` is False where none can come.
    """

    message: Any
    stamp_ns: int
    arrival_ns: int
    image: Image | None = None
    expects_pose: bool = True


class ReadAhead(NamedTuple):
    """An image message whose picture is read elsewhere; `image` waits for it and raises what that raised."""

    header: Any
    image: Callable[[], Image]


class EdgeStream:
    """Takes messages by field name; whatever is wrong with one is a status, a reason and a count.

    Images are handed in by `on_image` and come out, in order, as edges from `ready`. With a `calibration` the
    camera is that of the calibration, not of camera_info, and images of another size are refused. `by_notch`:
    the notch is looked for in every image as it arrives, and there is one lens pose an image, which rests on
    it. The scope is used in `medium`, and a camera that was calibrated in another is converted to it; that of
    camera_info was calibrated in `camera_info_medium`. Tracks are numbered from `first_track_id` on. Raises
    PerceptionError for a calibration without a camera, or without the notch that is to be found.
    """

    def __init__(
        self,
        parameters: EdgeParameters | None = None,
        poses: PoseParameters | None = None,
        calibration: Calibration | None = None,
        *,
        by_notch: bool = False,
        first_track_id: int = 1,
        medium: Medium = SALINE,
        camera_info_medium: Medium = AIR,
    ) -> None:
        self._medium, self._camera_info_medium = medium, camera_info_medium
        self.detector = GapEdgeTracker(parameters, first_track_id)
        self.counts: Counter[str] = Counter()
        self.latest: GapEdges | None = None
        self.reason = "no image received yet"
        self.last_refusal = ""
        # Images whose pictures could be read, and why the last of the others could not.
        self.images_read = 0
        self.unread_reason = ""
        self._image: Image | None = None
        self._camera: Camera | None = None
        self._camera_flaw = NO_CAMERA
        self._camera_key: tuple[object, ...] = ()
        self.calibration = calibration
        # Why the images do not fit the calibration; empty if they do.
        self.size_flaw = ""
        self._camera_errors: CameraErrors | None = None
        if calibration is not None:
            intrinsics = calibration.require_camera()
            self._use_camera(intrinsics.camera(), calibration.medium, [BearingErrors(intrinsics)])
        self.longest_wait = (poses or PoseParameters()).max_pose_wait
        self._wait_ns = round(self.longest_wait * 1e9)
        self._notch: NotchFollower | None = None
        if by_notch:
            if calibration is None:
                raise PerceptionError("scope_rotation_notch needs a calibration_file of calibrate oblique")
            self._notch = NotchFollower(calibration.require_notch())
        self._poses = LensPosePredictor(LONGEST_FRAME_NS) if by_notch else LensPosePredictor()
        self._waiting: deque[_Waiting] = deque()
        # Of the lens poses; None before the first.
        self._segment: int | None = None
        # The image that is being looked at, and is not answered yet.
        self._unanswered: _Waiting | None = None

    @property
    def by_notch(self) -> bool:
        """Whether the notch is looked for."""
        return self._notch is not None

    @property
    def waiting(self) -> int:
        """Number of images that wait for a lens pose."""
        return len(self._waiting)

    def on_camera_info(self, message: Any) -> None:
        """Take the camera model of a sensor_msgs/CameraInfo; one that differs ends the track."""
        key = (message.width, message.height, message.distortion_model, tuple(message.k), tuple(message.d))
        if key == self._camera_key:
            return
        self._camera_key = key
        if self.calibration is not None:
            self._compare(message)
            return
        # Bearings by another model are not comparable with those before.
        self.detector.end_track()
        try:
            self._use_camera(camera_from_info(message), self._camera_info_medium, [])
        except PerceptionError as error:
            self._camera, self._camera_flaw = None, str(error)

    def _use_camera(self, camera: Camera, calibrated_in: Medium, errors: Sequence[ErrorSource]) -> None:
        """Use a camera that was calibrated in a medium, with the known errors of its numbers."""
        self._camera, self._camera_flaw = self._in_use(camera, calibrated_in), ""
        self._camera_errors = CameraErrors(camera, errors, calibrated_in, self._medium)

    def _in_use(self, camera: Camera, calibrated_in: Medium) -> Camera:
        return camera_in_medium(camera, calibrated_in.ratio_to(self._medium))

    def _compare(self, message: Any) -> None:
        """Count a camera_info that contradicts the calibration, which is used all the same."""
        assert self._camera is not None
        try:
            reported = self._in_use(camera_from_info(message), self._camera_info_medium)
        except PerceptionError:
            return  # an uncalibrated driver's is all zeros
        if angle := disagreement(self._camera, reported):
            self.counts[f"camera_info differs from the calibration by {angle}: the calibration is used"] += 1

    def on_lens_pose(self, message: Any) -> None:
        """Take a pose of the lens, a geometry_msgs/PoseWithCovarianceStamped; a bad one is left out."""
        try:
            self._poses.add(checked_lens_pose(message))
        except PerceptionError:
            self.counts["lens poses refused"] += 1

    def on_image(self, message: Any, now_ns: int = 0) -> NotchObservation | None:
        """Take a sensor_msgs/Image or sensor_msgs/CompressedImage that arrives at a time [ns].

        Returns its notch, which the pose of the lens depends on; None if the notch is not followed.
        """
        stamp = stamp_ns(message.header)
        if self._notch is None:
            self._waiting.append(_Waiting(message, stamp, now_ns))
            return None
        self._unanswered = _Waiting(message, stamp, now_ns)
        image, counted = None, ""
        try:
            image = self._read(message)
            self._refuse_other_size(image)
            observation = self._notch.look(stamp, image)
        except PerceptionError as error:
            observation = NotchObservation(stamp, nan, nan, str(error))
            # Its words hold sizes of this image, and there are as many as images.
            counted = "the image cannot be read"
        counted = counted or observation.reason
        self.counts["the notch is seen" if observation.seen else f"no turn of the scope: {counted}"] += 1
        self._waiting.append(_Waiting(message, stamp, now_ns, image, observation.seen))
        self._unanswered = None
        return observation

    def ready(self, now_ns: int = 0) -> Iterator[GapEdges]:
        """Edges of the images that need not wait at a time [ns]; each is looked at when it is asked for.

        Until the next is asked for, `latest`, `reason`, `detector` and `overlay` are those of the one just
        given.
        """
        while self._waiting:
            waiting = self._waiting[0]
            if self._must_wait(waiting, now_ns):
                return
            self._waiting.popleft()
            yield self._look(waiting)

    def drop_old(self, longest_lag_ns: int, now_ns: int = 0) -> int:
        """Drop the images before the newest that need not wait, if the first of them lags too far behind it.

        A live node that is starved calls this before `ready`: the newest image is worth more than the oldest.
        Ages are differences of the images' own stamps. Returns how many were dropped; they get no edges.
        """
        free = 0
        while free < len(self._waiting) and not self._must_wait(self._waiting[free], now_ns):
            free += 1
        if free < 2 or self._waiting[free - 1].stamp_ns - self._waiting[0].stamp_ns <= longest_lag_ns:
            return 0
        for _ in range(free - 1):
            self._waiting.popleft()
        return free - 1

    def _must_wait(self, waiting: _Waiting, now_ns: int) -> bool:
        """Whether the lens pose after an image is still to be waited for."""
        waited_ns = now_ns - waiting.arrival_ns
        # A clock that ran backwards does not measure the wait.
        in_time = 0 <= waited_ns < self._wait_ns and len(self._waiting) <= MOST_WAITING
        return in_time and waiting.expects_pose and self._poses.expects_after(waiting.stamp_ns)

    def finish(self) -> Iterator[GapEdges]:
        """Edges of the images for which no pose will come any more."""
        while self._waiting:
            yield self._look(self._waiting.popleft())

    def recover(self, reason: str) -> list[GapEdges]:
        """Reset after an exception: end the track and forget the lens poses; the camera stays.

        Returns the edges reported for the image that raised it, if there was one.
        """
        self.detector.restart()
        self._poses.clear()
        if (waiting := self._unanswered) is None:
            return []
        frame_id = str(waiting.message.header.frame_id)
        edges = GapEdges.without_points(waiting.stamp_ns, frame_id, EdgeStatus.UNKNOWN)
        return [self._answered(edges, reason)]

    def _look(self, waiting: _Waiting) -> GapEdges:
        self._unanswered = waiting
        stamp, frame_id = waiting.stamp_ns, str(waiting.message.header.frame_id)
        self._image = None
        try:
            image = self._read(waiting.message) if waiting.image is None else waiting.image
            self._image = image
            self._refuse_other_size(image)
            if self._camera is None:
                raise PerceptionError(self._camera_flaw)
            lens_pose = self._poses.at(stamp)
            self._settle_segment(stamp)
            edges = self.detector.process(stamp, image, self._camera, lens_pose, frame_id=frame_id)
            if self._camera_errors is not None and np.isfinite(edges.bearings).all():
                edges = replace(edges, camera_errors=self._camera_errors.of(edges.bearings))
            reason = self.detector.reason
        except PerceptionError as error:
            self.detector.end_track()
            edges = GapEdges.without_points(stamp, frame_id, EdgeStatus.UNKNOWN)
            reason = str(error)
        return self._answered(edges, reason)

    def _answered(self, edges: GapEdges, reason: str) -> GapEdges:
        """The edges of an image, noted and counted with the reason why they are not valid."""
        self._unanswered = None
        self.latest, self.reason = edges, reason
        self.last_refusal = self.reason or self.last_refusal
        self.counts[edges.status.name] += 1
        if edges.pose_used:
            self.counts["with the pose of the lens"] += 1
        if edges.status is EdgeStatus.VALID and any(edges.hidden):
            self.counts["VALID, a point hidden"] += 1
        return edges

    def _settle_segment(self, stamp: int) -> None:
        """End the track where the lens poses up to an image do not follow from those before.

        A body that slipped while nobody saw it comes back with sound poses: the views before and after are
        not of one frame, so their points must not pass for the same two.
        """
        segment = self._poses.segment_at(stamp)
        if segment is None or segment == self._segment:
            return
        if self._segment is not None and self.detector.end_track():
            self.counts[f"tracks ended: {self._poses.break_reason}"] += 1
        self._segment = segment

    def _read(self, message: Any) -> Image:
        try:
            refuse_stamp(message.header)
            image = message.image() if isinstance(message, ReadAhead) else read_image(message)
        except PerceptionError as error:
            self.unread_reason = str(error)
            raise
        self.images_read += 1
        return image

    def _refuse_other_size(self, image: Image) -> None:
        self.size_flaw = ""
        if self.calibration is None:
            return
        try:
            self.calibration.require_image_size(image.shape[1], image.shape[0])
        except PerceptionError as error:
            self.size_flaw = str(error)
            raise

    def choose(self, column: float, row: float) -> str:
        """Begin a track at the gap nearest to a pixel of the last image; return why not, empty if done."""
        if self._camera is None:
            return self._camera_flaw
        return self.detector.choose_near([column, row], self._camera)

    def mask(self) -> Image | None:
        """Gap of the last image, 255 where it is (h, w); None where that image could not be read."""
        return None if self._image is None else self.detector.gap_mask(self._image)

    def overlay(self) -> Image | None:
        """The last image with all that was found drawn on it; None where it could not be read."""
        mask = self.mask()
        if self._image is None or self.latest is None or mask is None:
            return None
        diameter = self.detector.parameters.instrument_diameter
        instrument = diameter / self.detector.section_distance if diameter > 0.0 else float("nan")
        return draw_overlay(self._image, self.latest, mask, self.reason, self._camera, instrument)


def read_image(message: Any) -> Image:
    """Return the picture of a sensor_msgs/Image or sensor_msgs/CompressedImage. Raises PerceptionError."""
    return image_from_compressed(message) if hasattr(message, "format") else image_from_message(message)
