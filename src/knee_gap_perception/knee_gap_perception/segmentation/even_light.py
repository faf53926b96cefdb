"""Correction of vignetting: the fall-off of light towards the rim of the image.

Lens and lamp lose light towards the rim: tissue there is as dark as the middle of a gap that a veil of fluid
lights up. The model: the logarithm of brightness falls with the square of the distance from the field's
middle. The strength is the one that separates the image into three classes most clearly.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.segmentation.three_classes import otsu3

LOG_OFFSET = 12.0  # [grey levels]: so that the noise of a black gap does not become a class
COARSE = 4  # levels per bin in the comparison of strengths
STRENGTHS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)  # [levels] loss between middle and rim


class EvenLight(NamedTuple):
    """Corrected brightness (h, w), [0, 255], and the last values of its two darker classes."""

    level: npt.NDArray[np.uint8]
    dark: float
    middle: float


def log_levels(image: Image, offset: float = LOG_OFFSET) -> npt.NDArray[np.float32]:
    """Logarithm of the mean of the channels of an image (h, w, 3), scaled to [0, 255] (h, w).

    The larger the offset [grey levels], the closer it is to brightness itself.
    """
    curve = np.log1p(np.arange(256) / offset).astype(np.float32)
    mean = cv2.transform(image, np.full((1, 3), 1 / 3))
    return np.asarray(cv2.LUT(mean, 255.0 * curve / curve[-1]), dtype=np.float32)


def even_light(image: Image, field: Mask) -> EvenLight:
    """Corrected and classified brightness of an image (h, w, 3) within a field (h, w), which is not empty."""
    level, away = log_levels(image), _square_of_distance(field)
    inside, distance = level[field], away[field] - 0.5
    # The strengths are compared on fewer levels, at a fraction of the cost.
    clearness = [
        otsu3((np.clip(inside + strength * distance, 0.0, 255.0) / COARSE).astype(np.uint8), 256 // COARSE)[2]
        for strength in STRENGTHS
    ]
    strength = STRENGTHS[int(np.argmax(clearness))]
    evened = np.asarray(np.clip(level + strength * (away - 0.5), 0.0, 255.0), np.uint8)
    classes = otsu3(evened[field])
    return EvenLight(evened, classes.dark, classes.middle)


def _square_of_distance(field: Mask) -> npt.NDArray[np.float32]:
    """Square of the distance from the middle of the field's box, against half its longer side (h, w)."""
    rows, columns = np.flatnonzero(field.any(axis=1)), np.flatnonzero(field.any(axis=0))
    middle = (rows[0] + rows[-1]) / 2, (columns[0] + columns[-1]) / 2
    half = max(rows[-1] - rows[0], columns[-1] - columns[0]) / 2 + 1
    row, column = np.ogrid[: field.shape[0], : field.shape[1]]
    return np.asarray(((row - middle[0]) ** 2 + (column - middle[1]) ** 2) / half**2, dtype=np.float32)
