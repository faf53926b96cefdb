"""Conversion of poses from and to messages, by field name, for any class of message."""

from typing import Any

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, FramePose, LensPose
from knee_gap_core.values.stamps import set_stamp, stamp_ns


def body_pose_from_message(message: Any, name: str = "") -> BodyPose:
    """Body of a geometry_msgs/PoseStamped as published by a tracker driver, unchecked."""
    position, quaternion_xyzw = _position_and_quaternion(message.pose)
    return BodyPose(stamp_ns(message.header), position, quaternion_xyzw, name)


def lens_pose_from_message(message: Any) -> LensPose:
    """Lens pose of a geometry_msgs/PoseWithCovarianceStamped, unchecked."""
    position, quaternion_xyzw = _position_and_quaternion(message.pose.pose)
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return LensPose(
        stamp_ns(message.header), str(message.header.frame_id), position, quaternion_xyzw, covariance
    )


def fill_lens_pose(message: Any, lens: LensPose) -> Any:
    """Set every field of a geometry_msgs/PoseWithCovarianceStamped; returns the message."""
    fill_header(message.header, lens)
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


def fill_header(header: Any, lens: LensPose) -> None:
    """Set stamp and frame of a std_msgs/Header to those of a lens pose."""
    set_stamp(header, lens.stamp_ns)
    header.frame_id = lens.frame_id


def _position_and_quaternion(pose: Any) -> tuple[Array, Array]:
    """Position (3,) and quaternion (4,) of a geometry_msgs/Pose."""
    p, q = pose.position, pose.orientation
    return (
        np.array([p.x, p.y, p.z], dtype=np.float64),
        np.array([q.x, q.y, q.z, q.w], dtype=np.float64),
    )


def _fill_quaternion(message: Any, quaternion_xyzw: Array) -> None:
    message.x, message.y, message.z, message.w = (float(value) for value in quaternion_xyzw)
