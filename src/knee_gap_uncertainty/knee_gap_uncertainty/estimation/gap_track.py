"""One track: the two points of the anatomy from their first view to the present one."""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.errors import BaselineTooShortError, MeasurementError
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.acceptance import Facts, Kept, judge
from knee_gap_uncertainty.estimation.reference_view import ReferenceViews, between
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.instrument_gap.gap_profile import GapProfile, gap_profile
from knee_gap_uncertainty.instrument_gap.instrument_gap import (
    Edges,
    Opening,
    admitted_ranges,
    bounds_of_gap,
    flaw_of,
    instrument_gap,
    opening_of,
)
from knee_gap_uncertainty.instrument_gap.section_edges import SectionInView
from knee_gap_uncertainty.joint_motion.joint_motion import Finding, JointMotionTest
from knee_gap_uncertainty.motion_advice.motion_advice import Situation
from knee_gap_uncertainty.multi_view.confidence_interval import ConfidenceInterval, confidence_interval
from knee_gap_uncertainty.multi_view.keyframe_window import ViewWindow
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit
from knee_gap_uncertainty.multi_view.scale_drift import with_scale_drift
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.scope_calibration.calibration_fit import explained_by
from knee_gap_uncertainty.scope_calibration.posed_view import PosedView, posed_view
from knee_gap_uncertainty.scope_calibration.scope_calibration import CalibrationError
from knee_gap_uncertainty.two_view.angle_sets import INTERVAL_SIGNS, SIGNS
from knee_gap_uncertainty.two_view.gap_range import GapRange, gap_range_and_points
from knee_gap_uncertainty.two_view.translation_volume import displacements

# The direction of travel is that over this time [ns], if the lens went farther in it than this [m].
DIRECTION_TIME_NS = 250_000_000
DIRECTION_TRAVEL = 0.2e-3
FEWEST_VIEWS = 2  # that show a depth


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
        calibration: CalibrationError,
        camera_columns: int = 0,
        suspects_creep: bool = False,
    ) -> None:
        self._calibration = self._admitted = calibration
        # Whether no track has shown yet that the tracked body does not creep, or motion has ended one since.
        self.suspects_creep = suspects_creep
        self._camera_columns = camera_columns
        # Edges that state no error of their camera have that of one which nobody calibrated.
        self._camera_error = calibration.camera if camera_columns else parameters.camera_error
        self.track_id = track_id
        self.frame_id = frame_id
        self._parameters = parameters
        self._references: ReferenceViews | None = None
        # Of the present view: with which its bounds are made, and the bounds of the errors of both.
        self._reference: PosedView | None = None
        self._errors = np.inf, np.inf
        self._segment = 0
        self._window = ViewWindow()
        self._recent: deque[PosedView] = deque()
        self._direction = np.full(3, np.nan)
        self._joint_motion = JointMotionTest(parameters.tracker_drift, parameters.unproven_drift)
        self._section = SectionInView(parameters.longest_unseen_edges)
        self.ended = False
        # The last image that was found still, where the window does not keep it.
        self._passing: Views | None = None
        self.situation: Situation | None = None
        # Of the present image, where it shows more sections and the gap is valid.
        self.profile: GapProfile | None = None

    def continues_with(self, edges: GapEdges, pose: LensPose) -> bool:
        """Whether the edges are of the same points and camera, and the pose continues the earlier ones."""
        same = (edges.track_id, pose.frame_id) == (self.track_id, self.frame_id)
        # Errors of a camera are comparable with those of the same camera only.
        same &= edges.camera_errors.shape[-1] == self._camera_columns
        return same and not self.breaks_at(pose) and not self.ended

    def breaks_at(self, pose: LensPose) -> bool:
        """Whether the lens made a step, or was lost, between the track's views and this pose."""
        return self._references is not None and pose.segment != self._segment

    def add(self, edges: GapEdges, pose: LensPose) -> GapEstimate:
        """Add the next view; return the estimate at it."""
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
            view = posed_view(edges, pose, self._parameters.tracker_bound, self._camera_error)
        except MeasurementError as error:
            return self._refused(blank, Facts(self._parameters, edges_flaw=str(error)))
        if self._references is None:
            self._references, self._segment = ReferenceViews(view), pose.segment
        first, reference = self._references.first, self._references.of(view)
        self._reference = reference
        self._follow_direction(view)
        blank = replace(blank, baseline=between(view, reference), view_count=len(self._window))
        views = self._views_with(view.view)
        fitted, no_fit = self._fitted(views)
        finding = self._joint_motion.judge(*self._without_shared_error(views, fitted))
        if finding is not Finding.STILL:
            return self._contradicted(blank, finding)
        self._references.note(view)
        # The rate of creep is known along the way from the first view.
        if reference is first:
            self._admit_creep()
        self._errors = self._error_bounds(first, reference, view)
        self._passing = None if self._window.add(view.view) else view.view
        blank = replace(blank, view_count=len(self._window))
        if fitted is None:
            return self._refused(blank, Facts(self._parameters, error=no_fit))
        parameters = self._parameters
        fitted = with_scale_drift(
            fitted, views, first.lens, parameters.scale_drift, parameters.correlated_error_share
        )
        try:
            fitted = self._calibration.widened(fitted, views)
            interval = confidence_interval(fitted, self._parameters.confidence_level)
            all_views = AllViews(views, fitted, interval)
            section = self._section.at(edges, view, _nearest(fitted.points, view.lens))
            self.situation = self._situation(edges, view, all_views, section)
            bounds, parallax = self._bounds(reference, view)
        except MeasurementError as error:
            return self._refused(blank, Facts(self._parameters, error=error))
        return self._measured(blank, edges, view, bounds, parallax, all_views, section)

    def _views_with(self, present: Views) -> Views:
        """The views kept and then the present one, which is not kept before it has been found to fit them."""
        share = self._parameters.common_share
        alone = not len(self._window)
        return replace(present, common_share=share) if alone else self._window.views(share).joined(present)

    def _without_shared_error(
        self, views: Views, fitted: MultiViewFit | None
    ) -> tuple[Views, MultiViewFit | None, Views | None]:
        """The views, their fit and the passing view, less what the calibration's error explains of them."""
        shared = explained_by(self._calibration, views)
        if shared is None:
            return views, fitted, self._passing
        passing = None if self._passing is None else shared.taken_from(self._passing)
        corrected = shared.taken_from(views)
        return corrected, self._fitted(corrected)[0], passing

    def _admit_creep(self) -> None:
        """While creep is suspected, let the bounds admit the largest rate that the views leave possible."""
        rate = (
            self._joint_motion.largest_rate / self._parameters.tracker_bound if self.suspects_creep else 0.0
        )
        self.suspects_creep = rate > self._calibration.drift
        self._admitted = replace(self._calibration, drift=max(rate, self._calibration.drift))

    def _fitted(self, views: Views) -> tuple[MultiViewFit | None, MeasurementError | None]:
        """Fit over the views, or why there is none."""
        if len(views) < FEWEST_VIEWS:
            return None, BaselineTooShortError("a single view shows no depth")
        try:
            return fit(views), None
        except MeasurementError as error:
            return None, error

    def _contradicted(self, blank: GapEstimate, finding: Finding) -> GapEstimate:
        """No number from an image whose points are not where the track has them; the track may end here."""
        self.ended = finding is Finding.MOVED
        self.suspects_creep = self.suspects_creep or self.ended
        self.situation = None
        return self._refused(blank, Facts(self._parameters, finding=finding))

    def _refused(self, blank: GapEstimate, facts: Facts) -> GapEstimate:
        """What is known of every view, without a number, as the rule that the facts break has it."""
        verdict = judge(facts)
        assert verdict is not None
        return replace(blank, status=verdict.status, rejection=verdict.rejection)

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
        self, edges: GapEdges, present: PosedView, all_views: AllViews, section: Edges | str
    ) -> Situation | None:
        """What advice on motion can be based on; None while the points or the edges are not known at all."""
        assert self._references is not None
        assert self._reference is not None
        assert all_views.views.lens_rotations is not None
        if isinstance(section, str) or not np.isfinite(all_views.fit.points).all():
            return None
        angular_error, translation_error = self._errors
        return Situation(
            stamp_ns=present.stamp_ns,
            frame_id=edges.frame_id,
            track_id=self.track_id,
            first_lens=self._references.first.lens,
            reference_lens=self._reference.lens,
            lens=present.lens,
            rotation=all_views.views.lens_rotations[-1],
            points=all_views.fit.points,
            direction=self._direction,
            angular_error=angular_error,
            image_error=edges.angular_error,
            translation_error=translation_error,
            interval=self._parameters.interval,
            apex=self._parameters.apex,
            confidence_level=self._parameters.confidence_level,
            views=all_views.views,
            scale_drift=self._parameters.scale_drift,
            correlated_error_share=self._parameters.correlated_error_share,
            edges=section,
        )

    def _bounds(self, reference: PosedView, present: PosedView) -> tuple[GapRange, float]:
        """Bounds from another and the present view, and the smaller parallax of the two points [rad]."""
        angular_error, translation_error = self._errors
        bounds, points = gap_range_and_points(
            (reference.lens, present.lens),
            (reference.bearings, present.bearings),
            angular_error=angular_error,
            translation_error=translation_error,
            interval=self._parameters.interval,
            apex=self._parameters.apex,
        )
        return bounds, float(np.min(points.gamma))

    def _error_bounds(
        self, first: PosedView, reference: PosedView, present: PosedView
    ) -> tuple[float, float]:
        """Bounds of a bearing's [rad] and of a lens position's error [m], the calibration's included."""
        angle = max(reference.angular_error, present.angular_error)
        position = max(reference.translation_error, present.translation_error)
        shared = self._admitted.bounds(reference, present, self._parameters.tracker_bound, first.stamp_ns)
        return angle + shared[0], position + shared[1]

    def _measured(
        self,
        blank: GapEstimate,
        observation: GapEdges,
        view: PosedView,
        bounds: GapRange,
        parallax: float,
        all_views: AllViews,
        section: Edges | str,
    ) -> GapEstimate:
        """The estimate from the points' bounds and fit, and from the edges beside them in this image."""
        _, fitted, interval = all_views
        measured = replace(
            blank,
            status=GapStatus.VALID,
            point_distance=fitted.gap,
            point_distance_min=bounds.gap_min,
            point_distance_max=bounds.gap_max,
            point_distance_confidence_min=interval.lower,
            point_distance_confidence_max=interval.upper,
            parallax=parallax,
            view_count=fitted.view_count,
            points=fitted.points,
        )
        section_flaw = section if isinstance(section, str) else ""
        if not isinstance(section, str):
            opening = opening_of(view.bearings, section.bearings)
            ranges = np.linalg.norm(fitted.points - view.lens, axis=1)
            section_flaw = flaw_of(opening, ranges, section.error + observation.angular_error)
            if not section_flaw:
                measured = self._with_gap(measured, observation, view, fitted, opening, section)
        facts = Facts(
            self._parameters,
            section_flaw=section_flaw,
            at_border=not isinstance(section, str) and not section.bounded,
            measured=measured,
            depth_refused=bool(interval.refused),
            still_count=self._joint_motion.still_count,
            distance=float(np.linalg.norm(fitted.points - view.lens, axis=1).max()),
        )
        verdict = judge(facts)
        if verdict is None:
            return measured
        self.profile = None
        if verdict.kept is Kept.NOTHING:
            return self._refused(blank, facts)
        # The lower bounds stand; an upper one must not be taken for an answer.
        return replace(
            blank,
            status=verdict.status,
            rejection=verdict.rejection,
            gap_min=measured.gap_min,
            gap_max=np.inf,
            snr=0.0,
            confidence_min=measured.confidence_min,
            confidence_max=np.inf,
            point_distance_min=bounds.gap_min,
            point_distance_max=np.inf,
            point_distance_confidence_min=interval.lower,
            point_distance_confidence_max=np.inf,
            parallax=parallax,
            view_count=fitted.view_count,
            shares=measured.shares,
        )

    def _with_gap(
        self,
        measured: GapEstimate,
        observation: GapEdges,
        view: PosedView,
        fitted: MultiViewFit,
        opening: Opening,
        edges: Edges,
    ) -> GapEstimate:
        """The estimate with the instrument gap, its bounds and its interval."""
        near, far = self._admitted_ranges(view, opening)
        gap_min, gap_max = bounds_of_gap(near, far, opening, edges, observation.angular_error)
        if not np.isfinite(fitted.points).all():
            return replace(measured, gap_min=gap_min, gap_max=np.inf, confidence_min=0.0)
        radius = float(ndtri(0.5 + 0.5 * self._parameters.confidence_level))
        found = instrument_gap(fitted, view.lens, opening, edges, radius)
        if observation.sections:
            self.profile = self._profile(observation, view, fitted, (near, far), opening, edges)
        width = gap_max - gap_min
        return replace(
            measured,
            gap=found.gap,
            gap_min=gap_min,
            gap_max=gap_max,
            snr=found.gap / width if width > 0.0 else np.inf,
            confidence_min=found.lower,
            confidence_max=found.upper,
            instrument_point=found.point,
            instrument_axis=found.axis,
            shares=np.append(fitted.shares * (1.0 - found.shares.sum()), found.shares),
        )

    def _admitted_ranges(self, present: PosedView, opening: Opening) -> tuple[Array, Array]:
        """Distances (m, 2) [m] of the points that the errors of two views, one the present, allow."""
        assert self._reference is not None
        reference = self._reference
        angular_error, translation_error = self._errors
        return admitted_ranges(
            reference.lens - present.lens,
            present.bearings,
            reference.bearings,
            opening,
            angular_error,
            displacements(translation_error, 1),
            SIGNS[INTERVAL_SIGNS[self._parameters.interval]],
        )

    def _profile(
        self,
        observation: GapEdges,
        view: PosedView,
        fitted: MultiViewFit,
        near_far: tuple[Array, Array],
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
            np.linalg.norm(fitted.points - view.lens, axis=1) * opening.in_plane,
            near_far,
            opening,
            edges,
        )


def _nearest(points: Array, lens: Array) -> float:
    """Distance [m] of the nearer point (2, 3) from a lens (3,); infinite where neither is known."""
    return float(np.nanmin(np.linalg.norm(points - lens, axis=1), initial=np.inf))
