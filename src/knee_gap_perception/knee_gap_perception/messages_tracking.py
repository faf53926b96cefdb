"""Conversion of the calibration, the notch and the scope's rotation from and to messages, by field name."""

from math import isfinite, nan
from typing import Any

import numpy as np

from knee_gap_core.conversions.pose_messages import fill_header
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.camera.camera_errors import pupil_shift
from knee_gap_perception.camera.medium import Medium
from knee_gap_perception.scope_rotation.notch_tracker import NotchObservation

NO_REASON = "the notch was not detected, and no reason was given"


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
    fill_header(message.header, lens)
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
