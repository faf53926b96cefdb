"""What the project's own network sees: the square around the field, independent of white balance.

Training and use share this module, so that both see the same.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask

SIDE = 128  # [px] of the network's input
CHANNELS = 5
LOG_OFFSET = 12.0  # [grey levels]: so that the noise of black does not count
FEWEST = 32  # [px] of the field, below which colours are not normalised
LEAST_DEVIATION = 0.25  # [-] of log levels; a picture of even brightness is not stretched beyond it
_LOG = np.log1p(np.arange(256) / LOG_OFFSET).astype(np.float32)


class Square(NamedTuple):
    """A square part of an image: its first column and row, and its side [px]; may reach beyond the image."""

    x: int
    y: int
    side: int


def square_around(field: Mask) -> Square:
    """The square around a field (h, w); the whole image if the field is empty."""
    x, y, width, height = cv2.boundingRect(field.astype(np.uint8))
    if not width:
        height, width = field.shape
    side = max(width, height)
    return Square(x - (side - width) // 2, y - (side - height) // 2, side)


def cut_out(image: Image, square: Square) -> Image:
    """A square of an image (h, w) or (h, w, 3), with 0 beyond the image."""
    height, width = image.shape[:2]
    x0, y0 = max(square.x, 0), max(square.y, 0)
    x1, y1 = min(square.x + square.side, width), min(square.y + square.side, height)
    placed = np.zeros((square.side, square.side, *image.shape[2:]), image.dtype)
    placed[y0 - square.y : y1 - square.y, x0 - square.x : x1 - square.x] = image[y0:y1, x0:x1]
    return placed


def network_input(image: Image, field: Mask) -> npt.NDArray[np.float32]:
    """Channels (5, side, side) of a square image (side, side, 3) with a field (side, side).

    The logarithms of blue, green and red, each less its mean over the field, which is the picture's own
    white, in deviations of all; the brightest channel [0, 1], by which clipping is known; the field.
    """
    channels = np.zeros((CHANNELS, *field.shape), np.float32)
    inside = field.astype(np.float32)
    if field.sum() >= FEWEST:
        logs = cv2.LUT(image, _LOG)
        mean, deviation = cv2.meanStdDev(logs, mask=field.astype(np.uint8))
        scale = 1.0 / max(float(np.sqrt((deviation**2).mean())), LEAST_DEVIATION)
        for channel in range(3):
            channels[channel] = (logs[..., channel] - float(mean[channel, 0])) * (scale * inside)
    channels[3] = image.max(axis=2) * (inside / 255.0)
    channels[4] = inside
    return channels
