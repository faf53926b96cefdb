"""Messages to observations and estimates to messages, by field name: any classes with those fields serve."""

from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.gap_estimate import EdgeObservation, EdgeSection, EdgeState, GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_uncertainty.inputs.scope_rotations import ScopeRotation
from knee_gap_uncertainty.instrument_gap.gap_profile import GapProfile
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters, MotionAdvice
from knee_gap_uncertainty.scope_calibration.scope_calibration import ScopeCalibration

VALID_EDGES = 1
TARGETS = {"snr": 0, "width": 1}
INTERVALS = {"worst_case": 0, "paper": 1}
SHARES = (
    "share_image",
    "share_lens_position",
    "share_lens_rotation",
    "share_common",
    "share_edge",
    "share_shape",
)
# Plain numbers of GapEstimate, under the same name in the message.
NUMBERS = tuple(field.name for field in fields(GapEstimate) if field.type is float)


def edges_from_message(message: Any) -> EdgeObservation:
    """Observation of a knee_gap_msgs/GapEdges."""
    return EdgeObservation(
        stamp_ns=stamp_ns(message.header),
        track_id=int(message.track_id),
        usable=int(message.status) == VALID_EDGES and int(message.track_id) != 0,
        bearings=np.array([[b.x, b.y, b.z] for b in (message.bearing_0, message.bearing_1)], dtype=float),
        covariances=np.array([message.covariance_0, message.covariance_1], dtype=float).reshape(2, 3, 3),
        angular_error=float(message.angular_error),
        status=int(message.status),
        frame_id=str(message.header.frame_id),
        hidden=bool(message.hidden_0) or bool(message.hidden_1),
        pose_used=bool(message.pose_used),
        camera_errors=_camera_errors(message),
        kinds=(int(message.kind_0), int(message.kind_1)),
        section=EdgeSection(
            states=(int(message.edge_state_0), int(message.edge_state_1)),
            bearings=_edge_bearings(message),
            deviations=np.array([message.edge_deviation_0, message.edge_deviation_1], dtype=float),
            error=float(message.edge_error),
        ),
        sections=tuple(_section(section) for section in message.sections),
    )


def _edge_bearings(message: Any) -> npt.NDArray[np.float64]:
    """Bearings (2, 3) of the edges of a knee_gap_msgs/GapEdges or GapSection."""
    return np.array([[e.x, e.y, e.z] for e in (message.edge_0, message.edge_1)], dtype=float)


def _section(message: Any) -> EdgeSection:
    """Edges of a knee_gap_msgs/GapSection."""
    bearings, error = _edge_bearings(message), float(message.edge_error)
    state = EdgeState.SEEN if np.isfinite(bearings).all() and np.isfinite(error) else EdgeState.UNKNOWN
    return EdgeSection((state, state), bearings, np.full(2, error / 3.0), error)


def _camera_errors(message: Any) -> npt.NDArray[np.float64]:
    """Errors (2, 3, k) of the camera of a knee_gap_msgs/GapEdges; k is 0 where they are not known."""
    errors = np.array([message.camera_error_0, message.camera_error_1], dtype=float).reshape(2, 3, 9)
    return errors[:, :, :0] if np.isnan(errors).all() else errors


def pose_from_message(message: Any) -> LensPose:
    """Lens pose of a geometry_msgs/PoseWithCovarianceStamped."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return LensPose(
        stamp_ns=stamp_ns(message.header),
        frame_id=str(message.header.frame_id),
        position=np.array([p.x, p.y, p.z], dtype=float),
        quaternion_xyzw=np.array([q.x, q.y, q.z, q.w], dtype=float),
        covariance=np.array(message.pose.covariance, dtype=float).reshape(6, 6),
    )


def leg_pose_from_message(message: Any) -> LensPose:
    """Pose of the leg body of a geometry_msgs/PoseStamped, which tells no error."""
    p, q = message.pose.position, message.pose.orientation
    return LensPose(
        stamp_ns=stamp_ns(message.header),
        frame_id=str(message.header.frame_id),
        position=np.array([p.x, p.y, p.z], dtype=float),
        quaternion_xyzw=np.array([q.x, q.y, q.z, q.w], dtype=float),
        covariance=np.zeros((6, 6)),
    )


def calibration_from_message(message: Any) -> ScopeCalibration:
    """What a knee_gap_msgs/ScopeCalibration says."""
    return ScopeCalibration(
        node=str(message.node),
        hash=str(message.hash),
        lens_covariance=np.array(message.lens_covariance, dtype=float).reshape(6, 6),
        time_offset_error=float(message.time_offset_error),
        rotation_followed=bool(message.rotation_followed),
    )


def rotation_from_message(message: Any) -> ScopeRotation:
    """What a knee_gap_msgs/ScopeRotation says."""
    return ScopeRotation(stamp_ns(message.header), float(message.turn))


def fill_gap_estimate(message: Any, estimate: GapEstimate) -> Any:
    """Set every field of a default-constructed knee_gap_msgs/GapEstimate; returns the message."""
    set_stamp(message.header, estimate.stamp_ns)
    message.header.frame_id = estimate.frame_id
    message.status = int(estimate.status)
    message.track_id = estimate.track_id
    message.interval = INTERVALS[estimate.interval]
    message.reason = estimate.reason
    for name in NUMBERS:
        setattr(message, name, float(getattr(estimate, name)))
    message.view_count = estimate.view_count
    triples = (
        (message.point_0, estimate.points[0]),
        (message.point_1, estimate.points[1]),
        (message.instrument_point, estimate.instrument_point),
        (message.instrument_axis, estimate.instrument_axis),
    )
    for target, values in triples:
        target.x, target.y, target.z = (float(value) for value in values)
    for name, share in zip(SHARES, estimate.shares, strict=True):
        setattr(message, name, float(share))
    return message


def fill_gap_profile(message: Any, profile: GapProfile) -> Any:
    """Set every field of a default-constructed knee_gap_msgs/GapProfile; returns the message."""
    set_stamp(message.header, profile.stamp_ns)
    message.header.frame_id = profile.frame_id
    message.track_id = profile.track_id
    for name in ("position", "gap", "gap_min", "gap_max"):
        setattr(message, name, np.array(getattr(profile, name), dtype=np.float64))
    message.widest = profile.widest
    message.chosen_is_widest = profile.chosen_is_widest
    return message


def fill_motion_advice(message: Any, advice: MotionAdvice, parameters: AdviceParameters) -> Any:
    """Set every field of a default-constructed knee_gap_msgs/MotionAdvice; returns the message."""
    set_stamp(message.header, advice.stamp_ns)
    message.header.frame_id = advice.frame_id
    message.track_id = advice.track_id
    message.target_kind = TARGETS[parameters.advice_target]
    message.target = parameters.target
    for name, prospect in (("present", advice.present), ("best", advice.best)):
        direction = getattr(message, f"{name}_direction")
        direction.x, direction.y, direction.z = (float(value) for value in prospect.direction)
        setattr(message, f"{name}_travel", float(prospect.travel))
        setattr(message, f"{name}_best", float(prospect.best))
        setattr(message, f"{name}_best_travel", float(prospect.best_travel))
    return message
