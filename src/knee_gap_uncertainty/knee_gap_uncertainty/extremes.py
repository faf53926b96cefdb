"""Smallest and largest distance over all pairs of points of two clouds: exact, without trying all pairs.

Pairs of boxes that cannot beat the best pair found so far are skipped, first groups of slices, then slices;
only the points of the few left are compared.
"""

import math

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.compiled import compiled
from knee_gap_uncertainty.slices import SlicedCloud


@compiled
def extremes(one: SlicedCloud, other: SlicedCloud) -> tuple[float, float]:
    """Least and greatest distance over all pairs of a point of one and a point of the other."""
    rows, columns = one.group_low.shape[1], other.group_low.shape[1]
    bound_near, bound_far = math.inf, 0.0
    near_pair, far_pair = (0, 0), (0, 0)
    for i in range(rows):
        for j in range(columns):
            least = least_squared(one.group_low, one.group_high, i, other.group_low, other.group_high, j)
            greatest = greatest_squared(
                one.group_low, one.group_high, i, other.group_low, other.group_high, j
            )
            if least < bound_near:
                bound_near, near_pair = least, (i, j)
            if greatest > bound_far:
                bound_far, far_pair = greatest, (i, j)
    nearest, farthest = search(one, other, near_pair[0], near_pair[1], math.inf, 0.0)
    nearest, farthest = search(one, other, far_pair[0], far_pair[1], nearest, farthest)
    for i in range(rows):
        for j in range(columns):
            if (
                least_squared(one.group_low, one.group_high, i, other.group_low, other.group_high, j)
                < nearest
                or greatest_squared(one.group_low, one.group_high, i, other.group_low, other.group_high, j)
                > farthest
            ):
                nearest, farthest = search(one, other, i, j, nearest, farthest)
    return math.sqrt(nearest), math.sqrt(farthest)


@compiled(fastmath=True)
def least_squared(
    low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], i: int,
    other_low: npt.NDArray[np.float64], other_high: npt.NDArray[np.float64], j: int,
) -> float:  # fmt: skip
    """Square of the distance of box i to box j: no two of their points are closer."""
    total = 0.0
    for axis in range(3):
        between = max(other_low[axis, j] - high[axis, i], low[axis, i] - other_high[axis, j], 0.0)
        total += between * between
    return total


@compiled(fastmath=True)
def greatest_squared(
    low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], i: int,
    other_low: npt.NDArray[np.float64], other_high: npt.NDArray[np.float64], j: int,
) -> float:  # fmt: skip
    """Square of the distance of the remotest corners of boxes i and j: no two points are farther apart."""
    total = 0.0
    for axis in range(3):
        across = max(other_high[axis, j] - low[axis, i], high[axis, i] - other_low[axis, j])
        total += across * across
    return total


@compiled(fastmath=True)
def search(
    one: SlicedCloud, other: SlicedCloud, i: int, j: int, nearest: float, farthest: float,
) -> tuple[float, float]:  # fmt: skip
    """Better the squared distances found so far by the points of groups i and j."""
    for k in range(one.group_starts[i], one.group_starts[i + 1]):
        for m in range(other.group_starts[j], other.group_starts[j + 1]):
            if (
                least_squared(one.low, one.high, k, other.low, other.high, m) < nearest
                or greatest_squared(one.low, one.high, k, other.low, other.high, m) > farthest
            ):
                near, far = compare(
                    one.points,
                    one.starts[k],
                    one.starts[k + 1],
                    other.points,
                    other.starts[m],
                    other.starts[m + 1],
                )
                nearest, farthest = min(nearest, near), max(farthest, far)
    return nearest, farthest


@compiled(fastmath=True)
def compare(
    points: npt.NDArray[np.float64], start: int, end: int,
    others: npt.NDArray[np.float64], other_start: int, other_end: int,
) -> tuple[float, float]:  # fmt: skip
    """Least and greatest squared distance of the columns of one to those of the other."""
    nearest, farthest = math.inf, 0.0
    for i in range(start, end):
        x, y, z = points[0, i], points[1, i], points[2, i]
        for j in range(other_start, other_end):
            squared = (x - others[0, j]) ** 2 + (y - others[1, j]) ** 2 + (z - others[2, j]) ** 2
            nearest = min(nearest, squared)
            farthest = max(farthest, squared)
    return nearest, farthest
