"""One track: the two points of the anatomy from their first view to the present one."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_uncertainty.errors import (
    MeasurementError,
    ParallelToTravelError,
    RaysMeetBehindError,
    TravelTooShortError,
    UnboundedError,
)
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.gap_estimate import EdgeObservation, GapEstimate, GapStatus
from knee_gap_uncertainty.gap_range import gap_range
from knee_gap_uncertainty.pose_buffer import LensPose
from knee_gap_uncertainty.triangulation import triangulate
from knee_gap_uncertainty.two_views import two_views

# Why two views give no range, without the numbers: a reason that is counted must stay the same.
REASONS: dict[type[MeasurementError], str] = {
    TravelTooShortError: "the scope has hardly moved",
    ParallelToTravelError: "a point lies along the scope's travel",
    RaysMeetBehindError: "the rays to a point do not meet in front of the scope",
    UnboundedError: "the rays to a point are parallel",
}

Floats = npt.NDArray[np.float64]


class View(NamedTuple):
    """One view in the frame of the poses: lens (3,), bearings (2, 3), and the bounds of their errors.

    `angular_error` is psi = theta + omega [rad], `translation_error` DT [m].
    """

    stamp_ns: int
    lens: Floats
    bearings: Floats
    angular_error: float
    translation_error: float


class Track:
    """Keeps the first view as A0 and measures from it at every later one."""

    def __init__(self, track_id: int, frame_id: str, parameters: EstimatorParameters) -> None:
        self.track_id = track_id
        self.frame_id = frame_id
        self._parameters = parameters
        self._first: View | None = None
        self._view_count = 0

    def continues_with(self, edges: EdgeObservation, pose: LensPose) -> bool:
        """Whether the edges are of the same two points and the pose of the same reference frame."""
        return edges.track_id == self.track_id and pose.frame_id == self.frame_id

    def add(self, edges: EdgeObservation, pose: LensPose) -> GapEstimate:
        """Take the next view and return the estimate at it."""
        view = view_of(edges, pose, self._parameters.tracker_bound)
        if self._first is None:
            self._first = view
        self._view_count += 1
        baseline = float(np.linalg.norm(view.lens - self._first.lens))
        try:
            return self._measure(self._first, view, baseline)
        except MeasurementError as error:
            return self._refuse(view, baseline, REASONS.get(type(error), str(error)))

    def _measure(self, first: View, view: View, baseline: float) -> GapEstimate:
        bounds = gap_range(
            first.lens,
            view.lens,
            first.bearings,
            view.bearings,
            angular_error=max(first.angular_error, view.angular_error),
            translation_error=max(first.translation_error, view.translation_error),
            interval=self._parameters.interval,
            apex=self._parameters.apex,
        )
        two = triangulate(two_views(first.lens, view.lens, first.bearings, view.bearings))
        if not np.isfinite(bounds.gap_max):
            return self._refuse(view, baseline, "the admitted errors leave the gap unbounded", bounds.gap_min)
        return GapEstimate(
            stamp_ns=view.stamp_ns,
            frame_id=self.frame_id,
            status=GapStatus.VALID,
            track_id=self.track_id,
            interval=self._parameters.interval,
            gap=bounds.gap,
            gap_min=bounds.gap_min,
            gap_max=bounds.gap_max,
            snr=bounds.snr,
            baseline=baseline,
            parallax=float(np.min(two.gamma)),
            view_count=self._view_count,
            points=two.points_second,
        )

    def _refuse(self, view: View, baseline: float, reason: str, gap_min: float = np.nan) -> GapEstimate:
        return GapEstimate(
            stamp_ns=view.stamp_ns,
            frame_id=self.frame_id,
            status=GapStatus.INSUFFICIENT_PARALLAX,
            track_id=self.track_id,
            interval=self._parameters.interval,
            gap_min=gap_min,
            gap_max=np.inf if np.isfinite(gap_min) else np.nan,
            snr=0.0 if np.isfinite(gap_min) else np.nan,
            baseline=baseline,
            view_count=self._view_count,
            reason=reason,
        )


def view_of(edges: EdgeObservation, pose: LensPose, tracker_bound: float) -> View:
    """The view in the frame of the pose; tracked errors enter as `tracker_bound` times their RMS length."""
    rotation = Rotation.from_quat(pose.quaternion_xyzw)
    translation_rms = np.sqrt(np.trace(pose.covariance[:3, :3]))
    rotation_rms = np.sqrt(np.trace(pose.covariance[3:, 3:]))
    return View(
        stamp_ns=edges.stamp_ns,
        lens=pose.position,
        bearings=rotation.apply(edges.bearings),
        angular_error=edges.angular_error + tracker_bound * float(rotation_rms),
        translation_error=tracker_bound * float(translation_rms),
    )
