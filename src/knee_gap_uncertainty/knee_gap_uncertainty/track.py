"""One track: the two points of the anatomy from their first view to the present one."""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from knee_gap_uncertainty.angle_sets import INTERVAL_SIGNS, SIGNS
from knee_gap_uncertainty.calibration_fit import explained_by
from knee_gap_uncertainty.confidence_interval import ConfidenceInterval, confidence_interval
from knee_gap_uncertainty.depth_drift import with_depth_drift
from knee_gap_uncertainty.errors import (
    MeasurementError,
    ParallelToTravelError,
    RaysMeetBehindError,
    TravelTooShortError,
    UnboundedError,
)
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.gap_estimate import EdgeObservation, GapEstimate, GapStatus
from knee_gap_uncertainty.gap_profile import GapProfile, gap_profile
from knee_gap_uncertainty.gap_range import GapRange, gap_range
from knee_gap_uncertainty.instrument_gap import (
    Edges,
    Opening,
    admitted_ranges,
    bounds_of_gap,
    flaw_of,
    instrument_gap,
    opening_of,
)
from knee_gap_uncertainty.joint_motion import Finding, JointMotionTest
from knee_gap_uncertainty.motion_advice import Situation
from knee_gap_uncertainty.multi_view import MultiViewFit, fit
from knee_gap_uncertainty.pose_buffer import LensPose
from knee_gap_uncertainty.posed_view import PosedView, posed_view
from knee_gap_uncertainty.scope_calibration import CalibrationError
from knee_gap_uncertainty.section_edges import AT_BORDER, SectionInView
from knee_gap_uncertainty.translation_volume import displacements
from knee_gap_uncertainty.triangulation import triangulate
from knee_gap_uncertainty.two_views import two_views
from knee_gap_uncertainty.view_window import ViewWindow
from knee_gap_uncertainty.views import Views

Floats = npt.NDArray[np.float64]

# Why views give no number, without the values: a reason that is counted must stay the same.
REASONS: dict[type[MeasurementError], str] = {
    TravelTooShortError: "the scope has hardly moved",
    ParallelToTravelError: "a point lies along the scope's travel",
    RaysMeetBehindError: "the rays to a point do not meet in front of the scope",
    UnboundedError: "the rays to a point are parallel",
}
UNBOUNDED = "the admitted errors leave the gap unbounded"
UNCERTAIN_DEPTH = "the depth of a point is too uncertain"
CONTRADICTION = "the estimate from all views lies outside the bounds from two of them"
TOO_LARGE = "the gap is larger than any joint's"
UNCHECKED = "two views cannot check each other"
# Along the line of the ray from the other view, one of two views may be wrong by any amount.
FEWEST_VIEWS_TO_CHECK = 3


# The direction of travel is that over this time [ns], if the lens went farther in it than this [m].
DIRECTION_TIME_NS = 250_000_000
DIRECTION_TRAVEL = 0.2e-3


class AllViews(NamedTuple):
    """The views kept and the present one, the fit over them, and the confidence interval that it gives."""

    views: Views
    fit: MultiViewFit
    interval: ConfidenceInterval


class Track:
    """Keeps the first view as A0 for the bounds, and views from all along the way for the estimate."""

    def __init__(
        self,
        track_id: int,
        frame_id: str,
        parameters: EstimatorParameters,
        calibration: CalibrationError | None = None,
    ) -> None:
        self._calibration = calibration
        self.track_id = track_id
        self.frame_id = frame_id
        self._parameters = parameters
        self._first: PosedView | None = None
        self._window = ViewWindow()
        self._recent: deque[PosedView] = deque()
        self._direction = np.full(3, np.nan)
        self._joint_motion = JointMotionTest()
        self._section = SectionInView(parameters.longest_unseen_edges)
        self.ended = False
        # The last image that was found still, where the window does not keep it.
        self._passing: Views | None = None
        self.situation: Situation | None = None
        # Of the present image, where it shows more sections and the gap is valid.
        self.profile: GapProfile | None = None

    def continues_with(self, edges: EdgeObservation, pose: LensPose) -> bool:
        """Whether the edges are of the same two points and the pose of the same reference frame."""
        same = edges.track_id == self.track_id and pose.frame_id == self.frame_id
        return same and not self.ended

    def add(self, edges: EdgeObservation, pose: LensPose) -> GapEstimate:
        """Take the next view and return the estimate at it."""
        self.profile = None
        blank = GapEstimate(
            stamp_ns=edges.stamp_ns,
            frame_id=self.frame_id,
            status=GapStatus.INSUFFICIENT_PARALLAX,
            track_id=self.track_id,
            interval=self._parameters.interval,
            confidence_level=self._parameters.confidence_level,
        )
        try:
            view = posed_view(edges, pose, self._parameters.tracker_bound)
        except MeasurementError as error:
            return replace(blank, status=GapStatus.NO_EDGES, reason=str(error))
        if self._first is None:
            self._first = view
        self._follow_direction(view)
        views = self._views_with(view.view)
        fitted, flaw = self._fitted(views)
        finding = self._joint_motion.judge(*self._without_shared_error(views, fitted))
        if finding is not Finding.STILL:
            return self._contradicted(blank, view, finding)
        self._passing = None if self._window.add(view.view) else view.view
        if fitted is None:
            return self._told(blank, view, flaw)
        parameters = self._parameters
        fitted = with_depth_drift(
            fitted, views, self._first.lens, parameters.depth_drift, parameters.lasting_share
        )
        if self._calibration is not None:
            fitted = self._calibration.widened(fitted, views)
        try:
            interval = confidence_interval(fitted, self._parameters.confidence_level)
            all_views = AllViews(views, fitted, interval)
            section = self._section.at(edges, view, _nearest(fitted.points, view.lens))
            self.situation = self._situation(edges, view, all_views, section)
            bounds, parallax = self._bounds(self._first, view)
        except MeasurementError as error:
            return self._told(blank, view, REASONS.get(type(error), str(error)))
        return self._measured(blank, edges, view, bounds, parallax, all_views, section)

    def _views_with(self, present: Views) -> Views:
        """The views kept and then the present one, which is not kept before it has been found to fit them."""
        share = self._parameters.common_share
        if not len(self._window):
            return replace(present, common_share=share)
        return self._window.views(share).joined(present)

    def _without_shared_error(
        self, views: Views, fitted: MultiViewFit | None
    ) -> tuple[Views, MultiViewFit | None, Views | None]:
        """The views, their fit and the passing view, less what the calibration's error explains of them."""
        shared = explained_by(self._calibration, views) if self._calibration is not None else None
        if shared is None:
            return views, fitted, self._passing
        passing = None if self._passing is None else shared.taken_from(self._passing)
        corrected = shared.taken_from(views)
        return corrected, self._fitted(corrected)[0], passing

    def _fitted(self, views: Views) -> tuple[MultiViewFit | None, str]:
        """Fit over the views, or why there is none."""
        try:
            return fit(views), ""
        except MeasurementError as error:
            return None, REASONS.get(type(error), str(error))

    def _contradicted(self, blank: GapEstimate, view: PosedView, finding: Finding) -> GapEstimate:
        """No number from an image whose points are not where the track has them; the track may end here."""
        self.ended = finding is Finding.MOVED
        self.situation = None
        status = GapStatus.JOINT_MOVED if self.ended else GapStatus.UNKNOWN
        return replace(self._told(blank, view, finding.value), status=status)

    def _follow_direction(self, present: PosedView) -> None:
        """Note where the lens is going; it keeps its direction while it stands still."""
        self._recent.append(present)
        while present.stamp_ns - self._recent[0].stamp_ns > DIRECTION_TIME_NS:
            self._recent.popleft()
        travel = present.lens - self._recent[0].lens
        length = float(np.linalg.norm(travel))
        if length > DIRECTION_TRAVEL:
            self._direction = travel / length

    def _situation(
        self, edges: EdgeObservation, present: PosedView, all_views: AllViews, section: Edges | str
    ) -> Situation | None:
        """What advice on motion can be based on; None while the points or the edges are not known at all."""
        assert self._first is not None
        assert all_views.views.lens_rotations is not None
        if isinstance(section, str) or not np.isfinite(all_views.fit.points).all():
            return None
        angular_error, translation_error = self._error_bounds(self._first, present)
        return Situation(
            stamp_ns=present.stamp_ns,
            frame_id=edges.frame_id,
            track_id=self.track_id,
            first_lens=self._first.lens,
            lens=present.lens,
            rotation=all_views.views.lens_rotations[-1],
            points=all_views.fit.points,
            direction=self._direction,
            angular_error=angular_error,
            translation_error=translation_error,
            interval=self._parameters.interval,
            apex=self._parameters.apex,
            confidence_level=self._parameters.confidence_level,
            views=all_views.views,
            depth_drift=self._parameters.depth_drift,
            lasting_share=self._parameters.lasting_share,
            edges=section,
        )

    def _bounds(self, first: PosedView, present: PosedView) -> tuple[GapRange, float]:
        """Bounds from the first and the present view, and the smaller parallax of the two points [rad]."""
        angular_error, translation_error = self._error_bounds(first, present)
        bounds = gap_range(
            first.lens,
            present.lens,
            first.bearings,
            present.bearings,
            angular_error=angular_error,
            translation_error=translation_error,
            interval=self._parameters.interval,
            apex=self._parameters.apex,
        )
        views = two_views(first.lens, present.lens, first.bearings, present.bearings)
        return bounds, float(np.min(triangulate(views).gamma))

    def _error_bounds(self, first: PosedView, present: PosedView) -> tuple[float, float]:
        """Bounds of a bearing's [rad] and of a lens position's error [m], the calibration's included."""
        angle = max(first.angular_error, present.angular_error)
        position = max(first.translation_error, present.translation_error)
        if self._calibration is None:
            return angle, position
        shared = self._calibration.bounds(first, present, self._parameters.tracker_bound)
        return angle + shared[0], position + shared[1]

    def _measured(
        self,
        blank: GapEstimate,
        observation: EdgeObservation,
        view: PosedView,
        bounds: GapRange,
        parallax: float,
        all_views: AllViews,
        edges: Edges | str,
    ) -> GapEstimate:
        """The estimate from the points' bounds and fit, and from the edges beside them in this image."""
        _, fitted, interval = all_views
        points = replace(
            self._told(blank, view, ""),
            point_distance_min=bounds.gap_min,
            point_distance_max=bounds.gap_max,
            point_distance_confidence_min=interval.lower,
            point_distance_confidence_max=interval.upper,
            parallax=parallax,
            view_count=fitted.view_count,
        )
        if isinstance(edges, str):
            return replace(points, status=GapStatus.NO_EDGES, reason=edges)
        opening = opening_of(view.bearings, edges.bearings)
        if flaw := flaw_of(opening):
            return replace(points, status=GapStatus.NO_EDGES, reason=flaw)
        near, far, angular_error = self._admitted_ranges(view, opening)
        gap_min, gap_max = bounds_of_gap(near, far, opening, edges, angular_error)
        estimate = replace(points, gap_min=gap_min, gap_max=gap_max, snr=0.0)
        if not edges.bounded:
            return replace(estimate, status=GapStatus.NO_EDGES, gap_max=np.inf, reason=AT_BORDER)
        if self._joint_motion.still_count < FEWEST_VIEWS_TO_CHECK:
            return _unbounded(estimate, UNCHECKED)
        if not (np.isfinite(bounds.gap_max) and np.isfinite(gap_max)):
            return _unbounded(estimate, UNBOUNDED)
        if interval.refused or not np.isfinite(fitted.gap):
            # The lower bounds stand; an upper one must not be taken for an answer.
            return _unbounded(estimate, UNCERTAIN_DEPTH)
        radius = float(norm.ppf(0.5 + 0.5 * self._parameters.confidence_level))
        found = instrument_gap(fitted, view.lens, opening, edges, radius)
        if found.gap > self._parameters.largest_gap:
            return replace(self._told(blank, view, TOO_LARGE), status=GapStatus.UNKNOWN)
        if not (bounds.gap_min <= fitted.gap <= bounds.gap_max and gap_min <= found.gap <= gap_max):
            return replace(self._told(blank, view, CONTRADICTION), status=GapStatus.UNKNOWN)
        if observation.sections:
            distances = np.linalg.norm(fitted.points - view.lens, axis=1)
            self.profile = self._profile(observation, view, distances, (near, far), opening, edges)
        return replace(
            estimate,
            status=GapStatus.VALID,
            gap=found.gap,
            snr=found.gap / (gap_max - gap_min),
            confidence_min=found.lower,
            confidence_max=found.upper,
            instrument_point=found.point,
            instrument_axis=found.axis,
            point_distance=fitted.gap,
            points=fitted.points,
            shares=np.append(fitted.shares * (1.0 - found.shares.sum()), found.shares),
        )

    def _admitted_ranges(self, present: PosedView, opening: Opening) -> tuple[Floats, Floats, float]:
        """Distances (m, 2) [m] of the points that the admitted errors allow, and the bound psi [rad]."""
        assert self._first is not None
        angular_error, translation_error = self._error_bounds(self._first, present)
        near, far = admitted_ranges(
            self._first.lens - present.lens,
            present.bearings,
            self._first.bearings,
            opening,
            angular_error,
            displacements(translation_error, 1),
            SIGNS[INTERVAL_SIGNS[self._parameters.interval]],
        )
        return near, far, angular_error

    def _profile(
        self,
        observation: EdgeObservation,
        view: PosedView,
        distances: Floats,
        near_far: tuple[Floats, Floats],
        opening: Opening,
        edges: Edges,
    ) -> GapProfile:
        assert view.view.lens_rotations is not None
        return gap_profile(
            observation.stamp_ns,
            self.frame_id,
            self.track_id,
            observation.sections,
            view.view.lens_rotations[0],
            distances * opening.in_plane,
            near_far,
            opening,
            edges,
        )

    def _told(self, blank: GapEstimate, view: PosedView, reason: str) -> GapEstimate:
        """What is known of every view: how far the lens has come, and the reason why there is no more."""
        assert self._first is not None
        baseline = float(np.linalg.norm(view.lens - self._first.lens))
        return replace(blank, baseline=baseline, view_count=len(self._window), reason=reason)


def _nearest(points: Floats, lens: Floats) -> float:
    """Distance [m] of the nearer point (2, 3) from a lens (3,); infinite where neither is known."""
    return float(np.nanmin(np.linalg.norm(points - lens, axis=1), initial=np.inf))


def _unbounded(estimate: GapEstimate, reason: str) -> GapEstimate:
    """The estimate with its lower bounds only."""
    return replace(
        estimate,
        gap_max=np.inf,
        confidence_max=np.inf,
        point_distance_max=np.inf,
        point_distance_confidence_max=np.inf,
        reason=reason,
    )
