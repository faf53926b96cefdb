"""Conversion of pose messages to bodies, and of lens poses to messages, by field name, for any class."""

from math import isfinite, nan
from typing import Any

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, FramePose, LensPose
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.camera.camera_errors import pupil_shift
from knee_gap_perception.camera.medium import Medium
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation

NO_REASON = "the notch was not detected, and no reason was given"


def body_pose_from_message(message: Any, name: str = "") -> BodyPose:
    """Body of a geometry_msgs/PoseStamped as published by a tracker driver, unchecked."""
    position, orientation = message.pose.position, message.pose.orientation
    return BodyPose(
        stamp_ns=stamp_ns(message.header),
        position=np.array([position.x, position.y, position.z], dtype=np.float64),
        quaternion_xyzw=np.array(
            [orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64
        ),
        name=name,
    )


def fill_lens_pose(message: Any, lens: LensPose) -> Any:
    """Set every field of a geometry_msgs/PoseWithCovarianceStamped; returns the message."""
    _fill_header(message.header, lens)
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = (float(value) for value in lens.position)
    _fill_quaternion(pose.orientation, lens.quaternion_xyzw)
    message.pose.covariance = np.array(lens.covariance, dtype=np.float64).reshape(36)
    return message


def fill_transform(message: Any, frame: FramePose) -> Any:
    """Set every field of a geometry_msgs/TransformStamped, as /tf carries it; returns the message."""
    set_stamp(message.header, frame.stamp_ns)
    message.header.frame_id, message.child_frame_id = frame.frame_id, frame.child_frame_id
    shift = message.transform.translation
    shift.x, shift.y, shift.z = (float(value) for value in frame.position)
    _fill_quaternion(message.transform.rotation, frame.quaternion_xyzw)
    return message


def fill_scope_calibration(
    message: Any,
    node: str,
    calibration: Calibration | None,
    *,
    rotation_followed: bool = False,
    medium: Medium | None = None,
) -> Any:
    """Set every field of a knee_gap_msgs/ScopeCalibration; returns the message.

    `node` is the name of the publishing node. Only tracking_node uses the lens on the body and the clock, and
    only it can track the rotation of the scope. In another `medium` than the calibration's (None: the same),
    the lens is shifted along its view.
    """
    message.node, message.hash = node, calibration.hash if calibration else ""
    message.rotation_followed = rotation_followed
    covariance = np.full((6, 6), np.nan)
    message.time_offset = message.time_offset_error = float("nan")
    if calibration is not None:
        message.width_px, message.height_px = calibration.width_px, calibration.height_px
    if calibration is not None and node == "tracking_node":
        # The calibration's order is rotation first, REP-103's is position first.
        covariance = np.roll(calibration.require_lens().covariance, 3, axis=(0, 1))
        covariance[2, 2] += pupil_shift(calibration.medium, medium or calibration.medium) ** 2
        if calibration.clock is not None:
            message.time_offset = calibration.clock.offset
            message.time_offset_error = calibration.clock.sigma
    message.lens_covariance = np.array(covariance, dtype=np.float64).reshape(36)
    return message


def fill_scope_rotation(message: Any, lens: LensPose) -> Any:
    """Set every field of a knee_gap_msgs/ScopeRotation; returns the message."""
    _fill_header(message.header, lens)
    message.header.frame_id = lens.child_frame_id
    message.turn = float(lens.scope_rotation)
    return message


def fill_scope_notch(message: Any, observation: NotchObservation, frame_id: str) -> Any:
    """Set every field of a knee_gap_msgs/ScopeNotch; returns the message."""
    set_stamp(message.header, observation.stamp_ns)
    message.header.frame_id = frame_id
    message.seen, message.reason = observation.seen, observation.reason
    message.angle, message.angle_error = float(observation.angle), float(observation.angle_error)
    return message


def notch_from_message(message: Any) -> NotchObservation:
    """The notch observation of a knee_gap_msgs/ScopeNotch; not seen if its numbers are invalid."""
    stamp = stamp_ns(message.header)
    reason = "" if message.seen else str(message.reason) or NO_REASON
    angle, error = float(message.angle), float(message.angle_error)
    if not reason and not (isfinite(angle) and isfinite(error) and error >= 0.0):
        reason = f"the notch's angle must be finite, with its error, not {angle:g} and {error:g}"
    return NotchObservation(stamp, nan if reason else angle, nan if reason else error, reason)


def _fill_header(header: Any, lens: LensPose) -> None:
    set_stamp(header, lens.stamp_ns)
    header.frame_id = lens.frame_id


def _fill_quaternion(message: Any, quaternion_xyzw: Array) -> None:
    message.x, message.y, message.z, message.w = (float(value) for value in quaternion_xyzw)
