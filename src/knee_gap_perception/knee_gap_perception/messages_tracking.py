"""Pose messages to bodies and lens poses to messages, by field name, whoever's classes they are."""

from typing import Any

import numpy as np

from knee_gap_perception.poses import BodyPose, LensPose


def body_pose_from_message(message: Any, name: str = "") -> BodyPose:
    """Body of a geometry_msgs/PoseStamped, unchecked, as a driver of the tracker publishes it."""
    position, orientation = message.pose.position, message.pose.orientation
    return BodyPose(
        stamp_ns=int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec),
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
    _fill_quaternion(pose.orientation, lens)
    message.pose.covariance = np.array(lens.covariance, dtype=np.float64).reshape(36)
    return message


def fill_lens_transform(message: Any, lens: LensPose) -> Any:
    """Set every field of a geometry_msgs/TransformStamped, as /tf carries it; returns the message."""
    _fill_header(message.header, lens)
    message.child_frame_id = lens.child_frame_id
    shift = message.transform.translation
    shift.x, shift.y, shift.z = (float(value) for value in lens.position)
    _fill_quaternion(message.transform.rotation, lens)
    return message


def _fill_header(header: Any, lens: LensPose) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(lens.stamp_ns, 1_000_000_000)
    header.frame_id = lens.frame_id


def _fill_quaternion(message: Any, lens: LensPose) -> None:
    message.x, message.y, message.z, message.w = (float(value) for value in lens.quaternion_xyzw)
