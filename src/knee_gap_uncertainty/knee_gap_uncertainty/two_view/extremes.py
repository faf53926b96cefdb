"""Smallest and largest distance over all pairs of points of two clouds: exact, without trying all pairs.

Pairs of boxes that cannot beat the best pair found so far are skipped, first groups of slices, then slices;
only the points of the few left are compared.
"""

import math

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_uncertainty.two_view.slices import Boxes, SlicedCloud


@compiled(fastmath=True)
def extremes(one: SlicedCloud, other: SlicedCloud) -> tuple[float, float]:
    """Least and greatest distance over all pairs of a point of one and a point of the other."""
    near_pair, far_pair = likely_groups(one.groups, other.groups)
    nearest, farthest = search(one, near_pair[0], other, near_pair[1], math.inf, 0.0)
    nearest, farthest = search(one, far_pair[0], other, far_pair[1], nearest, farthest)
    for i in range(one.group_starts.size - 1):
        for j in range(other.group_starts.size - 1):
            if may_better(one.groups, i, other.groups, j, nearest, farthest):
                nearest, farthest = search(one, i, other, j, nearest, farthest)
    return math.sqrt(nearest), math.sqrt(farthest)


@compiled(fastmath=True)
def likely_groups(groups: Boxes, others: Boxes) -> tuple[tuple[int, int], tuple[int, int]]:
    """Pairs of boxes likely to hold the nearest and the farthest points: searched first, they spare most."""
    nearest, farthest = math.inf, -1.0
    near_pair, far_pair = (0, 0), (0, 0)
    for i in range(groups.low.shape[1]):
        for j in range(others.low.shape[1]):
            least, greatest = least_squared(groups, i, others, j), greatest_squared(groups, i, others, j)
            if least < nearest:
                nearest, near_pair = least, (i, j)
            if greatest > farthest:
                farthest, far_pair = greatest, (i, j)
    return near_pair, far_pair


@compiled(fastmath=True)
def search(
    one: SlicedCloud, i: int, other: SlicedCloud, j: int, nearest: float, farthest: float
) -> tuple[float, float]:
    """Better the squared distances found so far by the points of groups i and j."""
    for k in range(one.group_starts[i], one.group_starts[i + 1]):
        points = one.points[:, one.starts[k] : one.starts[k + 1]]
        for m in range(other.group_starts[j], other.group_starts[j + 1]):
            if may_better(one.slices, k, other.slices, m, nearest, farthest):
                others = other.points[:, other.starts[m] : other.starts[m + 1]]
                near, far = compare(points, others)
                nearest, farthest = min(nearest, near), max(farthest, far)
    return nearest, farthest


@compiled(fastmath=True)
def compare(points: npt.NDArray[np.float64], others: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Least and greatest squared distance of the columns of one to those of the other."""
    nearest, farthest = math.inf, 0.0
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        for j in range(others.shape[1]):
            squared = (x - others[0, j]) ** 2 + (y - others[1, j]) ** 2 + (z - others[2, j]) ** 2
            nearest = min(nearest, squared)
            farthest = max(farthest, squared)
    return nearest, farthest


@compiled(inlined=True)
def may_better(boxes: Boxes, i: int, others: Boxes, j: int, nearest: float, farthest: float) -> bool:
    """Whether points of box i and box j can be nearer or farther than the squared distances found so far."""
    return bool(
        least_squared(boxes, i, others, j) < nearest or greatest_squared(boxes, i, others, j) > farthest
    )


@compiled(inlined=True)
def least_squared(boxes: Boxes, i: int, others: Boxes, j: int) -> float:
    """Square of the distance of box i to box j: no two of their points are nearer."""
    total = 0.0
    for axis in range(3):
        between = max(
            others.low[axis, j] - boxes.high[axis, i], boxes.low[axis, i] - others.high[axis, j], 0.0
        )
        total += between * between
    return total


@compiled(inlined=True)
def greatest_squared(boxes: Boxes, i: int, others: Boxes, j: int) -> float:
    """Square of the distance of the remotest corners of boxes i and j: no two of their points are farther."""
    total = 0.0
    for axis in range(3):
        across = max(others.high[axis, j] - boxes.low[axis, i], boxes.high[axis, i] - others.low[axis, j])
        total += across * across
    return total
