"""From the images of a scope to the two points of the gap: find it, choose the points, follow them."""

from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeKind, EdgeStatus, GapEdges, SectionEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_perception.camera.camera import Camera, bearing_jacobian
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.cross_section import Section
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.gap_detection.gap_detector import Found, GapSearch, NoPointsError, check_light
from knee_gap_perception.gap_detection.section_edges import SectionEdgeFinder
from knee_gap_perception.image.field_of_view import (
    FieldOfView,
    FieldOfViewFinder,
    sparse_inside,
    why_no_field,
)
from knee_gap_perception.point_tracking.point_selection import SurfacePoint, choose_points
from knee_gap_perception.point_tracking.point_tracker import PointObservation, PointTracker
from knee_gap_perception.point_tracking.points_beside_opening import points_beside_opening
from knee_gap_perception.point_tracking.tangent_plane import View

# Channels of the image in which points are looked for, one after the other: green has the least noise, but a
# cast or a strong lamp clips one channel before the others.
CHANNELS = (1, 0, 2)
AROUND_EDGES = 40.0  # [px] beyond the tracked points within which instruments are looked for


@dataclass(frozen=True)
class _Track:
    """Two points being followed in a `channel` of the images.

    `pose_frame` is that of the lens poses from its first image on, if any.
    """

    track_id: int
    points: tuple[PointTracker, PointTracker]
    kinds: tuple[EdgeKind, EdgeKind]
    pose_frame: str | None
    clicked: Array | None
    edges: SectionEdgeFinder
    channel: int


class GapEdgeTracker:
    """Takes the images of one scope in order and returns the edges of the gap in each.

    The same images, stamps and poses give the same edges to the last bit. Nothing in the content of an image
    raises: its fault is a status and a `reason`.
    """

    def __init__(self, parameters: EdgeParameters | None = None, first_track_id: int = 1) -> None:
        """Tracks are numbered from `first_track_id` on.

        Raises PerceptionError where the segmentation cannot be had (a network that cannot be read).
        """
        self.parameters = parameters or EdgeParameters()
        self._search = GapSearch(self.parameters)
        self._finder = FieldOfViewFinder()
        self._track: _Track | None = None
        self._next_track_id = first_track_id
        self._seen_ns = 0
        self._profile_ns: int | None = None
        self._stamp_ns: int | None = None
        self._image: Image | None = None
        self._thumbnail: Image | None = None
        self._identical = 0
        self._clicked: Array | None = None
        self._pose_frame = ""
        self._reason = "no image was looked at yet"
        # OpenCV's threads would fight with the other nodes for a gain of nothing at these sizes.
        cv2.setNumThreads(1)

    @property
    def reason(self) -> str:
        """Why the last image gave no valid points, in words; empty where it did."""
        return self._reason

    @property
    def confidence(self) -> float:
        """Confidence [0, 1] of the last search that its dark part is a gap; NaN where it found none."""
        return self._search.confidence

    @property
    def section_distance(self) -> float:
        """Distance [m] of the tissue beside the section, by the lens poses; NaN where it is not known."""
        if self._track is None:
            return float("nan")
        return float(np.mean([point.distance for point in self._track.points]))

    def end_track(self) -> bool:
        """Forget the points, so that the next image starts a new track; return whether there were any."""
        ended = self._track is not None
        self._track = None
        return ended

    def restart(self) -> None:
        """Forget the points, what was clicked, and the evidence of a gap in earlier images."""
        self._clicked = None
        self._search.forget()
        self.end_track()

    def choose_at(self, pixel: npt.ArrayLike) -> None:
        """Start a new track at the section nearest to a clicked pixel (2,) of the next image."""
        self._clicked = np.asarray(pixel, dtype=np.float64)
        # What was seen elsewhere is no evidence for this place.
        self._search.forget()
        self.end_track()

    def choose_near(self, pixel: npt.ArrayLike, camera: Camera) -> str:
        """As `choose_at`, if the last image shows a gap there; otherwise return why not."""
        if self._image is None:
            return "no image received yet"
        clicked = np.asarray(pixel, dtype=np.float64)
        height, width = self._image.shape[:2]
        if not (np.isfinite(clicked).all() and (clicked >= -0.5).all() and (clicked < [width, height]).all()):
            place = f"{clicked[0]:g}, {clicked[1]:g}"
            return f"the point must lie in the image of {width}x{height} px, not at {place}"
        field = self._finder.find(self._image)
        if field is None:
            return why_no_field(self._image)
        if field.depth_inside(clicked) <= 0:
            return "the point lies outside the field of view"
        try:
            found = self._search.section(self._image, camera, field, clicked)
            self._chosen_points(self._image, camera, field, found)
        except (NoPointsError, PerceptionError) as refusal:
            return str(refusal)
        self.choose_at(clicked)
        return ""

    def process(
        self,
        stamp_ns: int,
        image: Image,
        camera: Camera,
        lens_pose: LensPose | None = None,
        frame_id: str = "arthroscope_optical",
    ) -> GapEdges:
        """The edges in an image (h, w, 3), blue green red, or (h, w) grey, exposed at a stamp [ns].

        `lens_pose` is the pose of the lens at that stamp if it is known. It predicts where the points
        are, through whatever hides them; where they are seen the image decides.
        """
        try:
            picture = self._checked(stamp_ns, image, camera)
            view = View.of(lens_pose) if lens_pose is not None else None
            if lens_pose is not None:
                self._settle_frame(lens_pose.frame_id)
            edges = self._points(stamp_ns, picture, camera, view, frame_id)
            self._reason = ""
        except NoPointsError as refusal:
            self._reason = str(refusal)
            track_id = self._track.track_id if self._track is not None else 0
            edges = GapEdges.without_points(stamp_ns, frame_id, refusal.status, track_id)
        except PerceptionError as error:
            self._reason = str(error)
            edges = GapEdges.without_points(stamp_ns, frame_id, EdgeStatus.UNKNOWN)
        return edges

    def gap_mask(self, image: Image | None = None) -> Image:
        """Gap of an image (h, w, 3), by default the last, 255 where it is (h, w); (0, 0) before the first."""
        image = self._image if image is None else image
        if image is None:
            return np.zeros((0, 0), np.uint8)
        field = self._finder.find(image)
        if field is None:
            return np.zeros(image.shape[:2], np.uint8)
        return self._search.mask(image, field)

    def _checked(self, stamp_ns: int, image: Image, camera: Camera) -> Image:
        """The image as blue, green, red, if it and its stamp can be used at all."""
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            self._refuse(
                f"an image must be (h, w, 3) or (h, w) of 8 bits, not {image.shape} of {image.dtype}"
            )
        if min(image.shape[:2]) < 64:
            self._refuse(f"an image must have at least 64x64 px, not {image.shape[1]}x{image.shape[0]} px")
        if (camera.width_px, camera.height_px) != (image.shape[1], image.shape[0]):
            self.end_track()
            self._refuse(
                f"camera_info is for {camera.width_px}x{camera.height_px} px, "
                f"the image has {image.shape[1]}x{image.shape[0]} px"
            )
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            # An image that comes twice adds nothing; stamps that run backwards are another recording.
            if stamp_ns == self._stamp_ns:
                self._refuse("the image has the stamp of the one before")
            self.end_track()
        self._stamp_ns = stamp_ns
        picture = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if self._image is not None and self._image.shape != picture.shape:
            self.end_track()
        self._image = picture
        self._check_frozen(picture)
        return picture

    def _refuse(self, reason: str) -> None:
        raise NoPointsError(EdgeStatus.UNKNOWN, reason)

    def _check_frozen(self, picture: Image) -> None:
        # Noise makes every image of a live camera differ, even of a scene that does not move.
        thumbnail = picture[7::24, 3::8].copy()
        same = self._thumbnail is not None and np.array_equal(thumbnail, self._thumbnail)
        self._thumbnail = thumbnail
        self._identical = self._identical + 1 if same else 0
        if self._identical + 1 >= self.parameters.frozen_images:
            raise NoPointsError(
                EdgeStatus.UNKNOWN, f"the video is frozen: {self._identical + 1} identical images"
            )

    def _points(
        self, stamp_ns: int, picture: Image, camera: Camera, view: View | None, frame_id: str
    ) -> GapEdges:
        field = self._finder.find(picture)
        if field is None:
            self.end_track()
            raise NoPointsError(EdgeStatus.LOW_CONTRAST, why_no_field(picture))
        if self._track is None:
            observations, grey = self._start(stamp_ns, picture, camera, view, field)
        else:
            self._check_light_while_tracking(stamp_ns, picture, field)
            grey = _channel(picture, self._track.channel)
            observations = self._follow(stamp_ns, grey, camera, view, field)
        edges = self._edges(stamp_ns, frame_id, camera, observations)
        first, second = observations
        section, sections = self._section_edges(stamp_ns, picture, grey, field, camera, edges.pixels)
        return replace(
            edges,
            hidden=(not first.seen, not second.seen),
            pose_used=view is not None,
            section=section,
            sections=sections,
        )

    def _section_edges(
        self,
        stamp_ns: int,
        picture: Image,
        grey: Image,
        field: FieldOfView,
        camera: Camera,
        pixels: Array,
    ) -> tuple[SectionEdges, tuple[SectionEdges, ...]]:
        """The edges beside the points, and from time to time those at more sections along the opening."""
        assert self._track is not None
        since_ns = np.inf if self._profile_ns is None else abs(stamp_ns - self._profile_ns)
        profile = bool(since_ns >= 1e9 * self.parameters.profile_period)
        if profile:
            self._profile_ns = stamp_ns
        margin = AROUND_EDGES + (1.5 if profile else 0.5) * float(np.linalg.norm(pixels[1] - pixels[0]))
        foreign, scale, origin = self._search.foreign(picture, pixels, margin)
        return self._track.edges.find(
            stamp_ns, grey, foreign, scale, field, camera, pixels, profile=profile, origin=origin
        )

    def _settle_frame(self, pose_frame: str) -> None:
        """Restart the track if it cannot use poses in a frame.

        It was begun without any, before the tracker's first pose or while the tracker saw nothing; or with
        poses in another frame, as when the reference body changes.
        """
        self._pose_frame = pose_frame
        if self._track is not None and self._track.pose_frame != pose_frame:
            self._clicked = self._track.clicked
            self.end_track()

    def _start(
        self,
        stamp_ns: int,
        picture: Image,
        camera: Camera,
        view: View | None,
        field: FieldOfView,
    ) -> tuple[list[PointObservation], Image]:
        """Find the gap, choose the points and begin a track; also the channel that shows them."""
        found = self._search.agreed_section(stamp_ns, picture, camera, field, self._clicked)
        section, points, channel = self._chosen_points(picture, camera, field, found)
        grey = _channel(picture, channel)
        first, second = (
            PointTracker(grey, point.pixel, point.dark_below, camera, view, point.kind) for point in points
        )
        self._seen_ns = stamp_ns
        self._track = _Track(
            self._next_track_id,
            (first, second),
            (points[0].kind, points[1].kind),
            self._pose_frame if view is not None else None,
            self._clicked,
            SectionEdgeFinder(section.centre, section.across, np.stack([point.pixel for point in points])),
            channel,
        )
        self._next_track_id += 1
        self._clicked = None
        return [first.first, second.first], grey

    def _chosen_points(
        self, picture: Image, camera: Camera, field: FieldOfView, found: Found
    ) -> tuple[Section, list[SurfacePoint], int]:
        """A section that was found, the two points beside it, and the channel of the image that shows them.

        Raises NoPointsError if a side has none in any channel.
        """
        for section in chain([found.section], found.others):
            inset_px = self.parameters.inset / camera.radians_per_pixel(section.centre)
            for channel in CHANNELS:
                grey = _channel(picture, channel)
                if found.opening is not None:
                    masks = found.opening, found.instruments, found.foreign & ~found.instruments
                    points = points_beside_opening(grey, section, field, inset_px, masks, found.scale)
                else:
                    points = choose_points(
                        grey, section, field, inset_px, found.foreign, found.scale, found.instruments
                    )
                if points is not None:
                    return section, points, channel
        raise NoPointsError(EdgeStatus.LOW_CONTRAST, "beside the gap no edge with textured tissue was found")

    def _check_light_while_tracking(self, stamp_ns: int, picture: Image, field: FieldOfView) -> None:
        """Refuse a picture in which nothing can be seen, for one thing a lamp that went out.

        The track goes on after a short one, as after a point that was hidden.
        """
        inside = sparse_inside(field, (picture.shape[0], picture.shape[1]))
        try:
            blue, green, red = np.moveaxis(picture[8::16, 8::16], 2, 0)
            check_light(np.maximum(np.maximum(blue, green), red)[inside])
        except NoPointsError:
            if stamp_ns - self._seen_ns > 1e9 * self.parameters.maximum_unseen:
                self.end_track()
            raise

    def _follow(
        self, stamp_ns: int, grey: Image, camera: Camera, view: View | None, field: FieldOfView
    ) -> list[PointObservation]:
        """Both points in the next image; ends the track, with the reason, if they cannot be followed."""
        assert self._track is not None
        observations = [point.follow(grey, camera, view) for point in self._track.points]
        if all(observation.seen for observation in observations):
            self._seen_ns = stamp_ns
        margin = self.parameters.field_margin * field.extent
        if any(field.depth_inside(observation.position) < margin for observation in observations):
            raise self._ended(EdgeStatus.OUT_OF_VIEW, "a point has left the field of view")
        if stamp_ns - self._seen_ns > 1e9 * self.parameters.maximum_unseen:
            raise self._ended(EdgeStatus.LOW_CONTRAST, "a point was hidden for too long")
        return observations

    def _ended(self, status: EdgeStatus, reason: str) -> NoPointsError:
        self.end_track()
        return NoPointsError(status, reason)

    def _edges(
        self, stamp_ns: int, frame_id: str, camera: Camera, observations: list[PointObservation]
    ) -> GapEdges:
        """The message's values; raises NoPointsError where the points are not known well enough."""
        assert self._track is not None
        pixels = np.stack([observation.position for observation in observations])
        bearings = camera.bearings(pixels)
        jacobians = [bearing_jacobian(camera, pixel) for pixel in pixels]
        covariances = np.stack(
            [
                jacobian @ observation.covariance @ jacobian.T
                for jacobian, observation in zip(jacobians, observations, strict=True)
            ]
        )
        if not np.isfinite(bearings).all() or not np.isfinite(covariances).all():
            raise self._ended(EdgeStatus.OUT_OF_VIEW, "a point has left what the camera model describes")
        worst = max(float(np.linalg.eigvalsh(covariance)[-1]) for covariance in covariances)
        angular_error = self.parameters.error_factor * float(np.sqrt(worst))
        if angular_error > self.parameters.maximum_angular_error:
            raise NoPointsError(
                EdgeStatus.LOW_CONTRAST,
                f"a point is known to {np.degrees(angular_error):.2f} deg only, needed are "
                f"{np.degrees(self.parameters.maximum_angular_error):.2f} deg",
            )
        return GapEdges(
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            status=EdgeStatus.VALID,
            track_id=self._track.track_id,
            bearings=bearings,
            pixels=pixels,
            kinds=self._track.kinds,
            covariances=covariances,
            angular_error=angular_error,
        )


def _channel(picture: Image, channel: int) -> Image:
    """One channel (h, w) of an image (h, w, 3)."""
    return np.asarray(cv2.extractChannel(picture, channel), np.uint8)
