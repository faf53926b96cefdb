"""What is no tissue though it is bright: metal of instruments, and glare."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Image, Mask

NEUTRAL = 0.06  # [-] red above blue, against the brightest channel: below it is metal or the lamp
LIT = 45  # [grey levels] below which no colour can be told
SMALLEST = 3  # [px at working size] side of what is not noise
MARGIN = 2  # [px at working size] of the blurred border around it


def foreign_bodies(image: Image) -> Mask:
    """Pixels (h, w) of an image (h, w, 3) at working size that show metal or glare.

    Living tissue sends back more red than blue, even pale cartilage; steel and the lamp's own reflection do
    not. A picture without colour (a grey camera) has neither.
    """
    blue, green, red = (channel.astype(np.int16) for channel in cv2.split(image))
    value = np.maximum(np.maximum(blue, green), red)
    if np.array_equal(blue, red):
        return np.zeros(image.shape[:2], bool)
    neutral = ((red - blue) < NEUTRAL * value) & (value > LIT)
    kernel = np.ones((SMALLEST, SMALLEST), np.uint8)
    opened = cv2.morphologyEx(neutral.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    return np.asarray(cv2.dilate(opened, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) > 0)
