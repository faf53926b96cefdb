"""Conversion of messages to images and lens poses, by field name, for any class of message."""

from typing import Any

import cv2
import numpy as np

from knee_gap_core.conversions.pose_messages import lens_pose_from_message
from knee_gap_core.values.arrays import Image
from knee_gap_core.values.poses import FARTHEST, LensPose, is_unit
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


def checked_lens_pose(message: Any) -> LensPose:
    """Lens pose of a geometry_msgs/PoseWithCovarianceStamped.

    Raises PerceptionError for an invalid stamp, numbers that are not finite or out of range, and a quaternion
    that is not of unit length.
    """
    refuse_stamp(message.header)
    lens = lens_pose_from_message(message)
    position, quaternion, covariance = lens.position, lens.quaternion_xyzw, lens.covariance
    if not np.isfinite(np.concatenate([position, quaternion, covariance.ravel()])).all():
        raise PerceptionError("a lens pose must be finite")
    if not is_unit(quaternion):
        raise PerceptionError(f"the quaternion of a lens pose must be of unit length, not {quaternion}")
    if np.abs(position).max() > FARTHEST or np.abs(covariance).max() > FARTHEST**2:
        raise PerceptionError(f"a lens pose and its error must lie within {FARTHEST:g} m, not {position} m")
    return lens
