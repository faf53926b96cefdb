"""Error of the gap by the calibration of the scope, which all views of a track share.

A shift of the lens on its body is felt only where the scope turns between the views, be it in its camera head
(the picture then turns against the lens, and the error with it), a turn of it turns every bearing against the
travel, a clock that is off moves the lens along its way, and a camera whose numbers are off turns each
bearing by where it lies in the picture. None of it averages out, so it is not in the covariance of a lens
pose or a bearing: it is considered, as the common part of the image's error is. The gap's fit is taken as it
is, and to its covariance comes what the shared error does to it. The camera's errors and those of the lens on
its body are taken as independent, though one fit has found both and they mostly make up for each other.

A body that creeps on its scope is the same in kind: one rate, not known, that moves the lens ever farther.
What nobody calibrated has the errors that the parameters state: an uncalibrated scope is wide, not silent.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import UnderconstrainedError
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.multi_view.scale_drift import widened
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.scope_calibration.posed_view import PosedView
from knee_gap_uncertainty.scope_calibration.shared_error_kernel import moved_points, shared_views

HASH_DIGITS = 12  # of a hash, in words

# Standard deviations of shift [m] and rotation [rad] of the lens and of the clock [s] above which a
# reported error is a mistake.
LARGEST_LENS_ERRORS = np.repeat([0.1, 1.0], 3)
LARGEST_CLOCK_ERROR = 1.0
# Of a covariance that was written and read, relative to its standard deviations.
ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class ScopeCalibration:
    """The calibration that one node reports: the fields of knee_gap_msgs/ScopeCalibration.

    `hash` is empty where it uses none. `lens_covariance` (6, 6) is that of a small shift [m^2] and a small
    rotation [rad^2] of the lens on its body, in the frame of the lens, `time_offset_error` [s] that of the
    clock; all NaN where the node does not use them. `rotation_followed` is whether it reports the turn of the
    scope in its camera head with each pose.
    """

    node: str
    hash: str
    lens_covariance: Array
    time_offset_error: float
    rotation_followed: bool = False

    def flaw(self) -> str:
        """Why the reported error is impossible, in words; empty if it is not."""
        whose = f"the calibration's error that {self.node} reports"
        seconds, covariance = self.time_offset_error, self.lens_covariance
        if not (np.isnan(seconds) or 0.0 <= seconds <= LARGEST_CLOCK_ERROR):
            return f"{whose} has a clock's error outside [0, {LARGEST_CLOCK_ERROR:g}] s"
        if np.isnan(covariance).all():
            return ""
        if not np.isfinite(covariance).all():
            return f"{whose} has numbers that are NaN or infinite"
        variances = np.diag(covariance)
        if (variances < 0.0).any() or (variances > LARGEST_LENS_ERRORS**2).any():
            return f"{whose} has variances below 0 or larger than any lens's"
        deviations = np.sqrt(variances)
        scale = np.outer(deviations, deviations)
        if (np.abs(covariance - covariance.T) > ROUNDING * scale).any():
            return f"{whose} has a covariance that is not symmetric"
        correlation = covariance / np.where(scale > 0.0, scale, 1.0)
        beyond = (np.abs(covariance) > (1.0 + ROUNDING) * scale).any()
        if beyond or np.linalg.eigvalsh(correlation).min() < -ROUNDING:
            return f"{whose} has a covariance that is not positive semi-definite"
        return ""

    def says_the_same_as(self, other: "ScopeCalibration") -> bool:
        """Whether views by either are comparable: the same calibration, error and turns."""
        reported, before = (np.append(one.lens_covariance, one.time_offset_error) for one in (self, other))
        same = self.hash == other.hash and self.rotation_followed == other.rotation_followed
        return same and bool(np.array_equal(reported, before, equal_nan=True))


def contradiction(reported: dict[str, ScopeCalibration]) -> str:
    """Why nodes rest on different scopes, in words; empty where they do not."""
    if len({calibration.hash for calibration in reported.values()}) < 2:
        return ""
    each = ", ".join(f"{node} {reported[node].hash[:HASH_DIGITS] or 'none'}" for node in sorted(reported))
    return f"nodes use different calibrations of the scope: {each}"


def shared_error(reported: Iterable[ScopeCalibration], parameters: EstimatorParameters) -> "CalibrationError":
    """The error that all views share: what calibrations state, and the parameters where none does.

    A calibration without a hash, or one that has a `flaw`, states nothing.
    """
    used = [one for one in reported if one.hash and not one.flaw()]
    lens = (one.lens_covariance for one in used if not np.isnan(one.lens_covariance).all())
    clock = (one.time_offset_error for one in used if not np.isnan(one.time_offset_error))
    sizes = np.repeat([parameters.lens_position_error, parameters.lens_rotation_error], 3)
    return CalibrationError(
        covariance=next(lens, np.diag(sizes**2 / 3.0)),
        clock=next(clock, parameters.clock_error),
        camera=0.0 if used else parameters.camera_error,
        drift=parameters.tracker_drift,
        angular_drift=parameters.tracker_angular_drift,
        scale=parameters.tracker_scale,
    )


@dataclass(frozen=True, eq=False)
class CalibrationError:
    """The shared error: `covariance` (6, 6) and `clock` [s] as in ScopeCalibration.

    `camera` [-] is the relative error of a focal length that was not calibrated; the views themselves carry
    what it does, as it depends on where a point lies in the picture. `drift` [m/s] and `angular_drift`
    [rad/s] are RMS lengths of the rates at which the lens creeps on the tracked body from the first view on.
    `scale` [-] is the relative error of all distances between positions of the lens.
    """

    covariance: Array
    clock: float
    camera: float = 0.0
    drift: float = 0.0
    angular_drift: float = 0.0
    scale: float = 0.0

    def widened(self, fit: MultiViewFit, views: Views) -> MultiViewFit:
        """The fit with the shared error in its covariances and in the common part of its shares.

        Raises UnderconstrainedError if the rays to a point are parallel.
        """
        if not np.isfinite(fit.points).all() or views.lens_rotations is None:
            return fit
        shift = self._moved_points(fit, views)
        moved = shift @ self.root(shift.shape[1])
        return widened(fit, moved @ moved.T)

    def bounds(
        self, first: PosedView, present: PosedView, factor: float, begin_ns: int | None = None
    ) -> tuple[float, float]:
        """What the shared error adds to the bounds of an angle [rad] and of a lens position [m], two views.

        `factor` times the RMS length. Half of a difference between the positions counts at either view. Creep
        has begun at `begin_ns`, or at the first of the two views.
        """
        shift, turn = self.covariance[:3, :3], self.covariance[3:, 3:]
        felt = (present.view.calibrated_rotations[0] - first.view.calibrated_rotations[0]) / 2.0
        motions = [_motions(view.view)[0] for view in (first, present)]
        late = (motions[1][:3] - motions[0][:3]) / 2.0 * self.clock
        turned = max(float(motion[3:] @ motion[3:]) for motion in motions) * self.clock**2
        seen = max(_largest_displacement(view.view) for view in (first, present))
        begin = first.stamp_ns if begin_ns is None else begin_ns
        seconds = [1e-9 * (view.stamp_ns - begin) for view in (first, present)]
        angle = np.sqrt(np.trace(turn) + turned + seen**2 + (self.angular_drift * max(seconds)) ** 2)
        # The lens creeps on its body, which turns: what is felt is the difference in the world.
        at_first, at_present = (view.view.calibrated_rotations[0] for view in (first, present))
        apart = seconds[1] * at_present - seconds[0] * at_first
        crept = self.drift * float(np.linalg.norm(apart, 2)) / 2.0
        scaled = self.scale * (present.lens - first.lens) / 2.0
        position = np.sqrt(np.trace(felt @ shift @ felt.T) + late @ late + crept**2 + scaled @ scaled)
        return factor * float(angle), factor * float(position)

    def root(self, count: int) -> Array:
        """(count, count) whose product with its transpose is the covariance of all shared errors.

        They are shift, rotation and clock, and then those of camera, drift and scale, of a variance of 1.
        """
        root = np.eye(count)
        root[:6, :6] = self._lens_root
        root[6, 6] = self.clock
        return root

    @cached_property
    def _lens_root(self) -> Array:
        """(6, 6) root of `covariance`."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    def _moved_points(self, fit: MultiViewFit, views: Views) -> Array:
        """(6, 7 + k + 7): how far the points go with shift, rotation, clock, camera, drift and scale.

        By weighted least squares on the bearings, as the fit. Positions are counted from the last view's:
        what moves all lenses alike moves the points with them, and their distance not at all.
        """
        rates = (self.drift, self.angular_drift, self.scale)
        moved, meet = moved_points(shared_views(views), fit.points, fit.used, _seconds(views), rates)
        if not meet:
            raise UnderconstrainedError("the rays to a point are parallel, and no depth is known")
        return moved


def _motions(views: Views) -> Array:
    """(N, 6) velocity [m/s] and turning [rad/s] of the lens; zero where it is not known."""
    return np.zeros((len(views), 6)) if views.lens_motions is None else views.lens_motions


def _seconds(views: Views) -> Array:
    """(N,) time since the first view [s]; zero where it is not known."""
    return np.zeros(len(views)) if views.times is None else views.times - views.times[0]


def _camera_errors(views: Views) -> Array:
    """(N, 2, 3, k) displacements of the bearings by the errors of the camera; k is 0 if none are reported."""
    return np.zeros((len(views), 2, 3, 0)) if views.camera_errors is None else views.camera_errors


def _largest_displacement(views: Views) -> float:
    """RMS length [rad] of what the camera's errors do to the bearing that feels them most."""
    return float(np.sqrt((_camera_errors(views) ** 2).sum(axis=(-2, -1)).max()))
