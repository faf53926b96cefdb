"""Segmentation by brightness thresholds: the paper's Otsu, Otsu with three classes, and an adaptive one."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_perception.field_of_view import brightness
from knee_gap_perception.segmentation.strategy import Image, Mask

LOG_OFFSET = 32.0  # [grey levels]: the noise of a black gap makes no class of its own


def log_brightness(image: Image) -> npt.NDArray[np.uint8]:
    """Logarithm of the mean of the channels of an image (h, w, 3), as a grey level (h, w)."""
    levels = np.log((np.arange(256) + LOG_OFFSET) / LOG_OFFSET)
    curve = np.asarray(np.rint(255 * levels / levels[-1]), dtype=np.uint8)
    mean = cv2.transform(image, np.full((1, 3), 1 / 3))
    return np.asarray(cv2.LUT(mean, curve), dtype=np.uint8)


def otsu_threshold(values: npt.NDArray[np.uint8]) -> float:
    """Otsu's threshold of values (n,): the last value of the dark class."""
    threshold, _ = cv2.threshold(values.reshape(1, -1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return float(threshold)


def otsu3_threshold(values: npt.NDArray[np.uint8]) -> float:
    """The lower of Otsu's two thresholds of values (n,): the last value of the darkest of three classes.

    All pairs of thresholds are compared, as in Otsu (1979), section 4. His single threshold where there are
    fewer than three different values. (scikit-image has the same; to load it takes longer than a node may
    take to start.)
    """
    counts = np.bincount(values, minlength=256).astype(np.float64)
    if np.count_nonzero(counts) < 3:
        return otsu_threshold(values)
    mass = np.concatenate([[0.0], np.cumsum(counts)])
    moment = np.concatenate([[0.0], np.cumsum(counts * np.arange(256))])
    # The variance between the classes is, but for a constant, the sum of moment^2 / mass of each: table[i, j]
    # is that of the class of levels i to j - 1.
    width = mass[None, :] - mass[:, None]
    table = np.divide(
        (moment[None, :] - moment[:, None]) ** 2, width, out=np.zeros_like(width), where=width > 0
    )
    between = table[0, :, None] + table + table[:, -1][None, :]
    between = np.where(np.triu(np.ones_like(between, dtype=bool), 1), between, -1.0)
    return float(np.unravel_index(int(between.argmax()), between.shape)[0] - 1)


class Otsu:
    """The paper's: Otsu's threshold on the green channel, inside the field of view."""

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        green = image[..., 1]
        if not field.any():
            return field.copy()
        return np.asarray(field & (green <= otsu_threshold(green[field])))


class Otsu3:
    """Three classes on the logarithm of brightness, gap, shaded and lit tissue: only the darkest is the gap.

    Light falls with the square of the distance and with the cosine of incidence, so the classes are even in
    its logarithm; on brightness itself the shaded flank of a condyle goes to the gap. The mean of the three
    channels is the same for a far wall that glows red and for a veil of fluid.
    """

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        value = log_brightness(image)
        return np.asarray(field & (value <= otsu3_threshold(np.asarray(value[field], np.uint8))))


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
