"""Segmentation by regions, from scikit-image: watershed, and the active contour of Chan and Vese."""

import cv2
import numpy as np
from skimage.segmentation import morphological_chan_vese, watershed

from knee_gap_perception.field_of_view import brightness
from knee_gap_perception.segmentation.strategy import Image, Mask
from knee_gap_perception.segmentation.thresholds import otsu3_threshold


class Watershed:
    """Floods the brightness gradient from what is surely dark and what is surely lit."""

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        value = cv2.GaussianBlur(brightness(image), (0, 0), 1.0)
        threshold = otsu3_threshold(np.asarray(value[field], dtype=np.uint8))
        smooth = value.astype(np.float32)
        gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
        markers = np.zeros(field.shape, np.int32)
        markers[field & (value <= 0.7 * threshold)] = 1
        markers[field & (value >= 1.3 * threshold + 4)] = 2
        return np.asarray(watershed(gradient, markers, mask=field) == 1)  # type: ignore[no-untyped-call]


class ChanVese:
    """A contour that divides the picture into two parts of even brightness, started from the threshold's."""

    def __init__(self, iterations: int = 12, smoothing: int = 1) -> None:
        """`iterations` of the contour, each smoothed so many times."""
        self._iterations, self._smoothing = iterations, smoothing

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        value = brightness(image)
        start = field & (value <= otsu3_threshold(value[field]))
        # Lit tissue spans several times the range of the gap; levelling it leaves two even parts. Outside the
        # field the level is that of lit tissue, so that no contour forms on the rim.
        level = np.minimum(value, np.percentile(value[field], 50)).astype(np.float64)
        level[~field] = np.percentile(value[field], 50)
        grown = morphological_chan_vese(  # type: ignore[no-untyped-call]
            level, self._iterations, init_level_set=start.astype(np.int8), smoothing=self._smoothing
        )
        return np.asarray(field & (grown == 1))
