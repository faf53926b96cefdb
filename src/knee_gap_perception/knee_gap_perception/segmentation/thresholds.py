"""Segmentation by brightness thresholds: the paper's Otsu, Otsu with three classes, and an adaptive one."""

import cv2
import numpy as np
import numpy.typing as npt
from skimage.filters import threshold_multiotsu

from knee_gap_perception.field_of_view import brightness
from knee_gap_perception.segmentation.strategy import Image, Mask


def otsu_threshold(values: npt.NDArray[np.uint8]) -> float:
    """Otsu's threshold of values (n,): the last value of the dark class."""
    threshold, _ = cv2.threshold(values.reshape(1, -1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return float(threshold)


def otsu3_threshold(values: npt.NDArray[np.uint8]) -> float:
    """The lower of Otsu's two thresholds of values (n,); his single one where there are too few."""
    counts = np.bincount(values, minlength=256).astype(np.float64)
    if np.count_nonzero(counts) < 3:
        return otsu_threshold(values)
    used = np.flatnonzero(counts)
    lower, _ = threshold_multiotsu(  # type: ignore[no-untyped-call]
        hist=(counts[used[0] : used[-1] + 1], np.arange(used[0], used[-1] + 1))
    )
    return float(lower)


class Otsu:
    """The paper's: Otsu's threshold on the green channel, inside the field of view."""

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        green = image[..., 1]
        if not field.any():
            return field.copy()
        return np.asarray(field & (green <= otsu_threshold(green[field])))


class Otsu3:
    """Three classes on the logarithm of the darker of green and blue: only the darkest is the gap.

    The three are gap, shaded tissue and lit tissue. Light falls with the square of the distance and with
    the cosine of incidence, so classes are even in its logarithm: on the simulated knee the shaded flank of
    a condyle is lost to the gap otherwise (Dice 0.95 on the brightest channel, 0.98-0.99 here). Green and
    blue are dark in the gap even where the far wall of the joint glows red.
    """

    OFFSET = 16.0  # [grey levels] noise of a black gap makes no class of its own

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        value = cv2.LUT(np.asarray(cv2.min(image[..., 0], image[..., 1])), self._curve())
        return np.asarray(field & (value <= otsu3_threshold(np.asarray(value[field], np.uint8))))

    def _curve(self) -> npt.NDArray[np.uint8]:
        """The logarithm of a grey level as a grey level."""
        levels = np.log((np.arange(256) + self.OFFSET) / self.OFFSET)
        return np.asarray(np.rint(255 * levels / levels[-1]), dtype=np.uint8)


class Adaptive:
    """Dark against the surroundings: below a share of the mean brightness within a wide window.

    The mean is taken over the field only, so that the black surround darkens nothing.
    """

    def __init__(self, window: float = 0.5, share: float = 0.5) -> None:
        """`window`: side of the square against the image's rows; `share` of the mean below which is dark."""
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
