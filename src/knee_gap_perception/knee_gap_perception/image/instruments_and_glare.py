"""Detection of instruments and glare: bright pixels that are not tissue."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Image, Mask

NEUTRAL = 0.06  # [-] excess of red over blue, relative to the brightest channel; below it: metal or the lamp
LIT = 45  # [grey levels] below which colour is unreliable
SMALLEST = 3  # [px at working size] smallest side; smaller regions are noise
MARGIN = 2  # [px at working size] of the blurred border around them


def foreign_bodies(image: Image) -> Mask:
    """Pixels (h, w) of an image (h, w, 3) at working size that show metal or glare.

    Living tissue, even pale cartilage, reflects more red than blue. Steel and the lamp's own reflection do
    not. In an image without colour (from a grey camera) neither is detected.
    """
    blue, green, red = (channel.astype(np.int16) for channel in cv2.split(image))
    value = np.maximum(np.maximum(blue, green), red)
    if np.array_equal(blue, red):
        return np.zeros(image.shape[:2], bool)
    neutral = ((red - blue) < NEUTRAL * value) & (value > LIT)
    kernel = np.ones((SMALLEST, SMALLEST), np.uint8)
    opened = cv2.morphologyEx(neutral.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    return np.asarray(cv2.dilate(opened, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) > 0)
