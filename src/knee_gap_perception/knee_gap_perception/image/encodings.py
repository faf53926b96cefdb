"""The encodings in which capture cards deliver images, and their conversion to blue, green, red."""

from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Image
from knee_gap_perception.errors import PerceptionError


class Encoding(NamedTuple):
    """How one encoding of sensor_msgs/Image lies in memory.

    `channels` of `bits` each a pixel, in `planes` times as many rows as the image has. `even`: what columns
    and rows must be multiples of, since neighbouring pixels share their colour. `conversion` is OpenCV's,
    None where the pixels are blue, green, red already.
    """

    channels: int
    conversion: int | None
    bits: int = 8
    planes: float = 1.0
    even: tuple[int, int] = (1, 1)


# OpenCV names a Bayer pattern by its second row and column, ROS by its first.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2BGR,
    "bggr": cv2.COLOR_BayerRG2BGR,
    "gbrg": cv2.COLOR_BayerGR2BGR,
    "grbg": cv2.COLOR_BayerGB2BGR,
}
_UYVY = Encoding(2, cv2.COLOR_YUV2BGR_UYVY, even=(2, 1))
_YUYV = Encoding(2, cv2.COLOR_YUV2BGR_YUY2, even=(2, 1))

ENCODINGS: dict[str, Encoding] = {
    "bgr8": Encoding(3, None),
    "rgb8": Encoding(3, cv2.COLOR_RGB2BGR),
    "bgra8": Encoding(4, cv2.COLOR_BGRA2BGR),
    "rgba8": Encoding(4, cv2.COLOR_RGBA2BGR),
    "mono8": Encoding(1, cv2.COLOR_GRAY2BGR),
    "mono16": Encoding(1, cv2.COLOR_GRAY2BGR, bits=16),
    "8UC1": Encoding(1, cv2.COLOR_GRAY2BGR),
    "8UC3": Encoding(3, None),
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "nv12": Encoding(1, cv2.COLOR_YUV2BGR_NV12, planes=1.5, even=(2, 2)),
    "nv21": Encoding(1, cv2.COLOR_YUV2BGR_NV21, planes=1.5, even=(2, 2)),
    **{
        f"bayer_{pattern}{bits}": Encoding(1, conversion, bits=bits, even=(2, 2))
        for pattern, conversion in _BAYER.items()
        for bits in (8, 16)
    },
}


def encoding_of(name: str) -> Encoding:
    """The encoding of a name; raises PerceptionError where it is not supported."""
    found = ENCODINGS.get(name)
    if found is not None:
        return found
    choices = ", ".join(ENCODINGS)
    if name.startswith("16UC1"):
        raise PerceptionError(f"a depth image ('{name}') is not an image of the scope")
    raise PerceptionError(f"the image encoding must be one of {choices}, not '{name}'")


def decoded(
    data: bytes | Image, name: str, height: int, width: int, step: int, *, big_endian: bool = False
) -> Image:
    """Image (height, width, 3), blue green red, of the rows of `step` bytes in an encoding.

    Of 16 bits the upper eight are kept. Raises PerceptionError for unsupported encodings, empty images, sizes
    that the encoding does not have, and data that do not fill the image.
    """
    encoding = encoding_of(name)
    if height < 1 or width < 1:
        raise PerceptionError(f"an image must have at least 1x1 px, not {width}x{height} px")
    columns, rows = encoding.even
    if width % columns or height % rows:
        raise PerceptionError(
            f"an image in {name} must have a multiple of {columns}x{rows} px, not {width}x{height} px"
        )
    needed = width * encoding.channels * encoding.bits // 8
    if step < needed:
        raise PerceptionError(
            f"{width} px in {name} take {needed} bytes per row, but the image's step is {step}"
        )
    lines = int(height * encoding.planes)
    pixels = np.frombuffer(data, dtype=np.uint8)
    if pixels.size < lines * step:
        raise PerceptionError(
            f"{lines} rows of {step} bytes need {lines * step} bytes, the image has {pixels.size}"
        )
    pixels = pixels[: lines * step].reshape(lines, step)[:, :needed]
    if encoding.bits == 16:
        pixels = pixels[:, (0 if big_endian else 1) :: 2]
    pixels = pixels.reshape(lines, width, encoding.channels)
    if encoding.conversion is None:
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), encoding.conversion), dtype=np.uint8)
