"""Otsu's thresholds for three classes (Otsu 1979, section 4): all pairs are compared.

scikit-image has the same; to load it takes longer than a node may take to start.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class ThreeClasses(NamedTuple):
    """The last value of the dark and of the middle class, and how clearly the classes are parted.

    `clearness` is the variance between the classes against the whole, [0, 1].
    """

    dark: float
    middle: float
    clearness: float


def otsu3(values: npt.NDArray[np.uint8]) -> ThreeClasses:
    """Classes of values (n,), of which there is at least one."""
    counts = np.bincount(values, minlength=256).astype(np.float64)
    present = np.flatnonzero(counts)
    if len(present) < 3:
        return ThreeClasses(float(present[0]), float(present[0]), 1.0 if len(present) == 2 else 0.0)
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
    first, second = np.unravel_index(int(between.argmax()), between.shape)
    constant = moment[-1] ** 2 / mass[-1]
    whole = float((counts * np.arange(256) ** 2).sum() - constant)
    return ThreeClasses(float(first - 1), float(second - 1), float(between.max() - constant) / whole)
