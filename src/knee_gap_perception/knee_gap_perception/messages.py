"""Conversion of messages to images and poses, and of edges to messages, by field name, for any class."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import GapEdges, SectionEdges
from knee_gap_core.values.poses import FARTHEST, LensPose, is_unit
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.image.encodings import decoded


def refuse_stamp(header: Any) -> None:
    """Raise PerceptionError for an invalid stamp, whose nanoseconds are a second or more."""
    if int(header.stamp.nanosec) > 999_999_999:
        raise PerceptionError(f"a stamp's nanoseconds must be below 1000000000, not {header.stamp.nanosec}")


def image_from_message(message: Any) -> Image:
    """Image (height, width, 3), blue green red, of a sensor_msgs/Image.

    Raises PerceptionError as `decoded`.
    """
    return decoded(
        message.data,
        str(message.encoding),
        int(message.height),
        int(message.width),
        int(message.step),
        big_endian=bool(getattr(message, "is_bigendian", False)),
    )


def image_from_compressed(message: Any) -> Image:
    """Image (height, width, 3), blue green red, of a sensor_msgs/CompressedImage (JPEG, PNG, ...).

    Raises PerceptionError for data that cannot be decoded, more than 8 bits per channel, and depth and Bayer
    images.
    """
    description = str(message.format)
    encoding = description.split(";")[0].strip()
    if encoding.startswith("bayer") and "compressed bgr8" not in description:
        raise PerceptionError(f"a compressed Bayer image ('{description}') must be debayered first")
    if "compressedDepth" in description:
        raise PerceptionError(f"a depth image ('{description}') is not an image of the scope")
    data = np.frombuffer(message.data, dtype=np.uint8)
    if data.size == 0:
        raise PerceptionError("the compressed image is empty: 0 bytes")
    is_jpeg = data[:2].tobytes() == b"\xff\xd8"
    # A JPEG has 8 bits; other formats are read unchanged first, so that 16 bits are refused, not truncated.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if is_jpeg else cv2.IMREAD_UNCHANGED
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error as error:
        raise PerceptionError(
            f"the compressed image ('{description}') cannot be decoded: {error.err}"
        ) from error
    if image is None:
        raise PerceptionError(f"the compressed image ('{description}', {data.size} bytes) cannot be decoded")
    if image.dtype != np.uint8:
        raise PerceptionError(f"an image must have 8 bits per channel, not {image.dtype}")
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    elif image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
    return np.asarray(image, dtype=np.uint8)


def lens_pose_from_message(message: Any) -> LensPose:
    """Lens pose of a geometry_msgs/PoseWithCovarianceStamped.

    Raises PerceptionError for an invalid stamp, numbers that are not finite or out of range, and a quaternion
    that is not of unit length.
    """
    refuse_stamp(message.header)
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    position = np.array([place.x, place.y, place.z], dtype=np.float64)
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    if not np.isfinite(np.concatenate([position, quaternion, covariance.ravel()])).all():
        raise PerceptionError("a lens pose must be finite")
    if not is_unit(quaternion):
        raise PerceptionError(f"the quaternion of a lens pose must be of unit length, not {quaternion}")
    if np.abs(position).max() > FARTHEST or np.abs(covariance).max() > FARTHEST**2:
        raise PerceptionError(f"a lens pose and its error must lie within {FARTHEST:g} m, not {position} m")
    return LensPose(
        stamp_ns=stamp_ns(message.header),
        frame_id=str(message.header.frame_id),
        position=position,
        quaternion_xyzw=quaternion,
        covariance=covariance,
    )


def fill_gap_edges(message: Any, edges: GapEdges, blank_section: Callable[[], Any]) -> Any:
    """Set every field of a default-constructed knee_gap_msgs/GapEdges from edges; returns the message.

    `blank_section` makes a default-constructed knee_gap_msgs/GapSection of the same kind.
    """
    seconds, nanoseconds = divmod(edges.stamp_ns, 1_000_000_000)
    message.header.stamp.sec = seconds
    message.header.stamp.nanosec = nanoseconds
    message.header.frame_id = edges.frame_id
    message.status = int(edges.status)
    message.track_id = int(edges.track_id)
    for index in (0, 1):
        bearing = getattr(message, f"bearing_{index}")
        bearing.x, bearing.y, bearing.z = (float(value) for value in edges.bearings[index])
        setattr(message, f"pixel_{index}", np.array(edges.pixels[index], dtype=np.float64))
        setattr(message, f"kind_{index}", int(edges.kinds[index]))
        setattr(message, f"hidden_{index}", bool(edges.hidden[index]))
        setattr(
            message, f"covariance_{index}", np.array(edges.covariances[index], dtype=np.float64).reshape(9)
        )
        setattr(message, f"camera_error_{index}", _camera_error(edges.camera_errors[index]))
        setattr(message, f"edge_state_{index}", int(edges.section.states[index]))
        setattr(message, f"edge_pixel_{index}", np.array(edges.section.pixels[index], dtype=np.float64))
        setattr(message, f"edge_deviation_{index}", float(edges.section.deviations[index]))
    _fill_section(message, edges.section)
    message.sections = [_fill_section(blank_section(), section) for section in edges.sections]
    message.pose_used = bool(edges.pose_used)
    message.angular_error = float(edges.angular_error)
    return message


def _fill_section(message: Any, section: SectionEdges) -> Any:
    """Set the bearings of both edges and the bound of their errors."""
    for index in (0, 1):
        edge = getattr(message, f"edge_{index}")
        edge.x, edge.y, edge.z = (float(value) for value in section.bearings[index])
    message.edge_error = float(section.error)
    return message


def _camera_error(errors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Displacements (3, k), at most nine, in the message's layout (27,); NaN if there are none."""
    count = errors.shape[1]
    padded = np.full((3, 9), 0.0 if count else np.nan)
    padded[:, :count] = errors
    return padded.ravel()
