"""Conversion of messages to poses and calibrations, and of estimates to messages, by field name."""

from dataclasses import fields
from typing import Any

import numpy as np

from knee_gap_core.conversions.pose_messages import body_pose_from_message
from knee_gap_core.values.gap_estimate import GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_uncertainty.inputs.scope_rotations import ScopeRotation
from knee_gap_uncertainty.instrument_gap.gap_profile import GapProfile
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters, MotionAdvice
from knee_gap_uncertainty.scope_calibration.scope_calibration import ScopeCalibration

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


def leg_pose_from_message(message: Any) -> LensPose:
    """Pose of the leg body of a geometry_msgs/PoseStamped, which has no error."""
    body = body_pose_from_message(message)
    return LensPose(
        stamp_ns=body.stamp_ns,
        frame_id=str(message.header.frame_id),
        position=body.position,
        quaternion_xyzw=body.quaternion_xyzw,
        covariance=np.zeros((6, 6)),
    )


def calibration_from_message(message: Any) -> ScopeCalibration:
    """The calibration of a knee_gap_msgs/ScopeCalibration."""
    return ScopeCalibration(
        node=str(message.node),
        hash=str(message.hash),
        lens_covariance=np.array(message.lens_covariance, dtype=float).reshape(6, 6),
        time_offset_error=float(message.time_offset_error),
        rotation_followed=bool(message.rotation_followed),
    )


def rotation_from_message(message: Any) -> ScopeRotation:
    """The rotation of a knee_gap_msgs/ScopeRotation."""
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
