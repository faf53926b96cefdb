"""Otsu's thresholds for three classes (Otsu 1979, section 4), by comparison of all pairs.

scikit-image has the same function, but takes too long to load at the start of a node.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt


class ThreeClasses(NamedTuple):
    """Last values of the dark and of the middle class, and the separation of the classes.

    `clearness` is the variance between the classes divided by the total variance, [0, 1].
    """

    dark: float
    middle: float
    clearness: float


@cache
def _in_order(levels: int) -> npt.NDArray[np.bool_]:
    """Mask (levels, levels) of the pairs whose second level is the larger."""
    return np.triu(np.ones((levels, levels), dtype=bool), 1)


def otsu3(values: npt.NDArray[np.uint8], levels: int = 256) -> ThreeClasses:
    """Classes of values (n,) below `levels`; n is at least one."""
    # OpenCV counts faster than NumPy.
    counts = cv2.calcHist([values], [0], None, [levels], [0, levels]).ravel().astype(np.float64)
    present = np.flatnonzero(counts)
    if len(present) < 3:
        return ThreeClasses(float(present[0]), float(present[0]), 1.0 if len(present) == 2 else 0.0)
    mass = np.concatenate([[0.0], np.cumsum(counts)])
    moment = np.concatenate([[0.0], np.cumsum(counts * np.arange(levels))])
    # The variance between the classes is, apart from a constant, the sum of moment^2 / mass of each class:
    # table[i, j] is that of the class of levels i to j - 1.
    # In place, as these tables take most of the time.
    table = moment[None, :] - moment[:, None]
    np.square(table, out=table)
    width = mass[None, :] - mass[:, None]
    np.divide(table, width, out=table, where=width > 0)
    table[width <= 0] = 0.0
    between = table + table[0, :, None]
    between += table[:, -1][None, :]
    between[~_in_order(len(between))] = -1.0
    first, second = np.unravel_index(int(between.argmax()), between.shape)
    constant = moment[-1] ** 2 / mass[-1]
    whole = float((counts * np.arange(levels) ** 2).sum() - constant)
    return ThreeClasses(float(first - 1), float(second - 1), float(between.max() - constant) / whole)
