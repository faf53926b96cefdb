"""Segmentation by brightness thresholds: Otsu (the paper's), Otsu with three classes, and adaptive."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.image.field_of_view import brightness
from knee_gap_perception.segmentation.even_light import even_light


def otsu_threshold(values: npt.NDArray[np.uint8]) -> float:
    """Otsu's threshold of values (n,): the last value of the dark class."""
    threshold, _ = cv2.threshold(values.reshape(1, -1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return float(threshold)


class Otsu:
    """The paper's method: Otsu's threshold on the green channel, inside the field of view."""

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        green = image[..., 1]
        if not field.any():
            return field.copy()
        return np.asarray(field & (green <= otsu_threshold(green[field])))


class Otsu3:
    """Three classes of the logarithm of brightness: gap, shaded tissue and lit tissue.

    Light falls with the square of the distance and with the cosine of incidence, so the classes are even in
    its logarithm; with brightness itself, the shaded flank of a condyle is classified as gap. The mean of the
    three channels is the same for a far wall that glows red and for a veil of fluid. Vignetting is corrected
    first.
    """

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        evened = even_light(image, field)
        return np.asarray(field & (evened.level <= evened.dark))


class Adaptive:
    """Adaptive threshold: below a fraction of the mean brightness within a wide window.

    The mean is over the field only, so that the black surround does not lower it.
    """

    def __init__(self, window: float = 0.5, share: float = 0.5) -> None:
        """`window`: side of the square relative to the rows; `share`: threshold relative to the mean."""
        self._window, self._share = window, share

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        value = brightness(image).astype(np.float32)
        side = max(3, int(self._window * image.shape[0]) | 1)
        inside = field.astype(np.float32)
        total = cv2.boxFilter(
            value * inside, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        count = cv2.boxFilter(inside, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(field & (value < self._share * total / np.maximum(count, 1)))
