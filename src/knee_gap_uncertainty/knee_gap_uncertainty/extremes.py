"""Smallest and largest distance over all pairs of points of two clouds: exact, without trying all pairs.

Each cloud is cut into short slices along its rays, each slice boxed. Pairs of boxes that cannot beat the best
pair found so far are skipped, first in groups of slices, then slice by slice; only the points of the few left
are compared.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.compiled import compiled

# Slices for a cloud of n rings: SLICES * sqrt(n), in groups of GROUP; best in the benchmark over 1 to 4
# radii.
SLICES = 2.5
GROUP = 8


class SlicedCloud(NamedTuple):
    """A cloud sorted into boxes; corners are (3, count).

    `points` (3, n): slice i holds the columns `starts[i]` to `starts[i + 1]`, all between `low[:, i]` and
    `high[:, i]`. Group j holds the slices `group_starts[j]` to `group_starts[j + 1]`, between `group_low` and
    `group_high`.
    """

    points: npt.NDArray[np.float64]
    starts: npt.NDArray[np.int64]
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    group_starts: npt.NDArray[np.int64]
    group_low: npt.NDArray[np.float64]
    group_high: npt.NDArray[np.float64]


@compiled
def places_by_inverse(
    lengths: npt.NDArray[np.float64], bins: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Place of each ring when sorted coarsely by 1 / length, and the starts of the bins that are not empty.

    Inverse lengths spread far more evenly than lengths, whose tail runs off as the rays become parallel.
    """
    inverse = 1.0 / lengths
    lowest, highest = inverse.min(), inverse.max()
    per_bin = (bins - 0.5) / (highest - lowest) if highest > lowest else 0.0
    places = np.empty(lengths.size, np.int64)
    ends = np.zeros(bins + 1, np.int64)
    for ring in range(lengths.size):
        places[ring] = int((inverse[ring] - lowest) * per_bin)
        ends[places[ring] + 1] += 1
    ends = np.cumsum(ends)
    filled = ends[:-1].copy()
    for ring in range(lengths.size):
        chosen = places[ring]
        places[ring] = filled[chosen]
        filled[chosen] += 1
    return places, np.unique(ends)


@compiled(fastmath=True)
def boxes(
    columns: npt.NDArray[np.float64], starts: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Least and greatest coordinates (3, count) of the columns between successive starts."""
    count = starts.size - 1
    low, high = np.empty((3, count)), np.empty((3, count))
    for axis in range(3):
        row = columns[axis]
        for i in range(count):
            least = most = row[starts[i]]
            for j in range(starts[i] + 1, starts[i + 1]):
                least = min(least, row[j])
                most = max(most, row[j])
            low[axis, i], high[axis, i] = least, most
    return low, high


@compiled
def slice_cloud(points: npt.NDArray[np.float64], lengths: npt.NDArray[np.float64]) -> SlicedCloud:
    """Sort points (3, spokes, rings) into slices of like length, spoke by spoke, and box them."""
    spokes, rings = points.shape[1], points.shape[2]
    places, bins = places_by_inverse(lengths, max(1, int(SLICES * math.sqrt(rings))))
    ordered = np.empty((3, spokes, rings))
    for axis in range(3):
        for spoke in range(spokes):
            for ring in range(rings):
                ordered[axis, spoke, places[ring]] = points[axis, spoke, ring]
    columns = ordered.reshape(3, spokes * rings)
    starts = repeat_starts(bins, spokes)
    low, high = boxes(columns, starts)
    slices = bins.size - 1
    group_starts = repeat_starts(np.append(np.arange(0, slices, GROUP), slices), spokes)
    group_low, _ = boxes(low, group_starts)
    _, group_high = boxes(high, group_starts)
    return SlicedCloud(columns, starts, low, high, group_starts, group_low, group_high)


@compiled
def repeat_starts(starts: npt.NDArray[np.int64], times: int) -> npt.NDArray[np.int64]:
    """Starts of `times` copies of the same partition, one after the other, with the end of the last."""
    parts, total = starts.size - 1, starts[-1]
    repeated = np.empty(times * parts + 1, np.int64)
    for i in range(times * parts):
        repeated[i] = i // parts * total + starts[i % parts]
    repeated[-1] = times * total
    return repeated


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
