"""Clouds cut into short slices, each slice boxed: what lets a search skip nearly all of their points.

A cloud of the gap is drawn as spokes: lines of points along its ray that differ in length. Sorted by length,
a run of successive points of one spoke is short, and so is its box.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled

# Slices of a spoke of n points: SLICES * sqrt(n), in groups of GROUP. Fastest by `bench_extremes` for 1 to 4
# radii.
SLICES = 2.5
GROUP = 8


class Boxes(NamedTuple):
    """Boxes along the axes: their least and greatest corners (3, count)."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]


class SlicedCloud(NamedTuple):
    """A cloud in slices, and the slices in groups, each with its box.

    `points` (3, n): slice i holds the columns `starts[i]` to `starts[i + 1]`, all within box i of `slices`.
    Group j holds the slices `group_starts[j]` to `group_starts[j + 1]`, all within box j of `groups`.
    """

    points: npt.NDArray[np.float64]
    starts: npt.NDArray[np.int64]
    slices: Boxes
    group_starts: npt.NDArray[np.int64]
    groups: Boxes


@compiled
def places_by_inverse(
    lengths: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Place of each length when sorted coarsely by its inverse, and the starts of the slices with their end.

    Inverse lengths spread far more evenly than lengths, whose tail runs off as the rays become parallel.
    """
    inverse = 1.0 / lengths
    lowest, highest = inverse.min(), inverse.max()
    bins = math.ceil(SLICES * math.sqrt(lengths.size))
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


@compiled
def slice_spokes(points: npt.NDArray[np.float64], starts: npt.NDArray[np.int64]) -> SlicedCloud:
    """Box the slices of points (3, spokes, n): the same `starts`, from 0 to n, for every spoke."""
    spokes, count = points.shape[1], starts.size - 1
    columns = points.reshape(3, spokes * points.shape[2])
    slice_starts = repeat_starts(starts, spokes)
    slices = Boxes(lowest(columns, slice_starts), highest(columns, slice_starts))
    group_starts = repeat_starts(np.append(np.arange(0, count, GROUP), count), spokes)
    groups = Boxes(lowest(slices.low, group_starts), highest(slices.high, group_starts))
    return SlicedCloud(columns, slice_starts, slices, group_starts, groups)


@compiled(fastmath=True)
def lowest(columns: npt.NDArray[np.float64], starts: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Least coordinates (3, count) of the columns between successive starts."""
    low = np.empty((3, starts.size - 1))
    for axis in range(3):
        along = columns[axis]
        for i in range(starts.size - 1):
            least = along[starts[i]]
            for j in range(starts[i] + 1, starts[i + 1]):
                least = min(least, along[j])
            low[axis, i] = least
    return low


@compiled(fastmath=True)
def highest(columns: npt.NDArray[np.float64], starts: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Greatest coordinates (3, count) of the columns between successive starts."""
    high = np.empty((3, starts.size - 1))
    for axis in range(3):
        along = columns[axis]
        for i in range(starts.size - 1):
            most = along[starts[i]]
            for j in range(starts[i] + 1, starts[i + 1]):
                most = max(most, along[j])
            high[axis, i] = most
    return high


@compiled
def repeat_starts(starts: npt.NDArray[np.int64], times: int) -> npt.NDArray[np.int64]:
    """Starts of `times` copies of the same partition, one after the other, with the end of the last."""
    parts, total = starts.size - 1, starts[-1]
    repeated = np.empty(times * parts + 1, np.int64)
    for i in range(times * parts):
        repeated[i] = i // parts * total + starts[i % parts]
    repeated[-1] = times * total
    return repeated
