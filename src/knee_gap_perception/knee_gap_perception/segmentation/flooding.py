"""Segmentation by flooding the picture from what is sure: scikit-image's watershed."""

import cv2
import numpy as np
from skimage.segmentation import watershed

from knee_gap_perception.segmentation.strategy import Image, Mask
from knee_gap_perception.segmentation.thresholds import log_brightness, otsu3_threshold

GAP, TISSUE = 1, 2


class Watershed:
    """Floods the gradient of the logarithm of brightness from what is surely gap and what is surely tissue.

    Sure is what lies clear of the lower of three classes' thresholds; between, the border is where
    brightness changes fastest, whatever its level there: a veil of fluid or a shaded flank shifts the
    level, not the step.
    """

    MARGIN = (
        12.0  # [grey levels of the logarithm] on either side of the threshold, within which nothing is sure
    )

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        value = log_brightness(np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8))
        threshold = otsu3_threshold(value[field])
        smooth = value.astype(np.float32)
        gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
        markers = np.zeros(field.shape, np.int32)
        markers[field & (value < threshold - self.MARGIN)] = GAP
        markers[field & (value > threshold + self.MARGIN)] = TISSUE
        flooded = watershed(gradient, markers, mask=field)  # type: ignore[no-untyped-call]
        return np.asarray(flooded == GAP)
