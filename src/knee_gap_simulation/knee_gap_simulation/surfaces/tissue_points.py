"""Points of tissue sorted into blocks, and the room around an axis between them: compiled kernels."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError

IntArray = npt.NDArray[np.int64]

_BLOCK = 1.0e-3  # edge [m] of the cubes into which points are sorted
_CROSSINGS = 11  # positions of the axis on the section in the scan
_MOST_POINTS = 1500  # in the linear programme
_CROSSING_STEP = 1e-6  # [m]: accuracy of each tilt's best position


class TissuePoints(NamedTuple):
    """Points (n, 3) [m] sorted into blocks: block k holds ``starts[k]`` to ``starts[k + 1]``.

    ``centres`` (m, 3) and ``radii`` (m,) are of spheres around the blocks.
    """

    points: Array
    starts: IntArray
    centres: Array
    radii: Array

    @staticmethod
    def of(points: npt.ArrayLike) -> "TissuePoints":
        """Sort points (n, 3) [m] into blocks. Raises SimulationError unless they are finite."""
        values = np.asarray(points, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != 3 or not len(values) or not np.isfinite(values).all():
            raise SimulationError(f"points of tissue must be finite and (n, 3), not of shape {values.shape}")
        cells = np.floor((values - values.min(axis=0)) / _BLOCK).astype(np.int64)
        counts = cells.max(axis=0) + 1
        keys = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
        order = np.argsort(keys, kind="stable")
        starts = np.concatenate([[0], np.flatnonzero(np.diff(keys[order])) + 1])
        ordered = values[order]
        low = np.minimum.reduceat(ordered, starts)
        high = np.maximum.reduceat(ordered, starts)
        radii = 0.5 * np.linalg.norm(high - low, axis=1) + 1e-9
        return TissuePoints(ordered, np.append(starts, len(values)), 0.5 * (low + high), radii)

    def around(self, point: Array, direction: Array, radius: float, reach: float) -> "TissuePoints":
        """The blocks that a cylinder may touch, ``reach`` [m] before and behind a point (3,) of its axis."""
        away = self.centres - point
        along = away @ direction
        aside = np.sqrt(np.maximum((away * away).sum(axis=1) - along * along, 0.0))
        kept = np.flatnonzero((aside - self.radii <= radius) & (np.abs(along) - self.radii <= reach))
        counts = np.diff(self.starts)[kept]
        starts = np.append(0, np.cumsum(counts)).astype(np.int64)
        index = np.repeat(self.starts[kept] - starts[:-1], counts) + np.arange(starts[-1])
        return TissuePoints(self.points[index], starts, self.centres[kept], self.radii[kept])


class Extent(NamedTuple):
    """Region in which tissue counts: within ``reach`` [m] of the section along an axis, not before the lens.

    The lens is at a depth of ``lens`` [m] along the direction of view (3,).
    """

    reach: float
    viewing: Array
    lens: float


@compiled(nogil=True)
def scan(
    tissue: TissuePoints,
    start: Array,
    across: Array,
    width: float,
    direction: Array,
    extent: Extent,
) -> tuple[float, float]:
    """Largest free radius of parallel axes that cross the section, and the place of the crossing [m]."""
    best, crossing = 0.0, 0.5 * width
    for k in range(_CROSSINGS):
        s = width * (k + 0.5) / _CROSSINGS
        free = free_radius(tissue, start + s * across, direction, extent, best)
        if free > best:
            best, crossing = free, s
    # On one side the tissue above is nearest, on the other the tissue below: bisect for the best place.
    step = width / _CROSSINGS
    while step > _CROSSING_STEP:
        step *= 0.5
        for s in (crossing - step, crossing + step):
            free = free_radius(tissue, start + s * across, direction, extent, best)
            if free > best:
                best, crossing = free, s
    return best, crossing


@compiled(nogil=True)
def _nearest_in_block(
    tissue: TissuePoints, k: int, crossing: Array, direction: Array, extent: Extent, best: float
) -> tuple[float, int]:
    """Least squared distance from the axis below ``best`` in a block, and the point; -1 for none."""
    points, found = tissue.points, -1
    for i in range(tissue.starts[k], tissue.starts[k + 1]):
        x, y, z = points[i, 0] - crossing[0], points[i, 1] - crossing[1], points[i, 2] - crossing[2]
        along = x * direction[0] + y * direction[1] + z * direction[2]
        if abs(along) > extent.reach:
            continue
        # A difference of squares would lose half of the digits.
        x, y, z = x - along * direction[0], y - along * direction[1], z - along * direction[2]
        squared = x * x + y * y + z * z
        if squared < best:
            v = extent.viewing
            if points[i, 0] * v[0] + points[i, 1] * v[1] + points[i, 2] * v[2] >= extent.lens:
                best, found = squared, i
    return best, found


@compiled(nogil=True)
def _room(tissue: TissuePoints, k: int, crossing: Array, direction: Array, reach: float) -> float:
    """Lower bound of the distance of a block's points from the axis; infinite for a block out of reach."""
    x = tissue.centres[k, 0] - crossing[0]
    y = tissue.centres[k, 1] - crossing[1]
    z = tissue.centres[k, 2] - crossing[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if abs(along) - tissue.radii[k] > reach:
        return np.inf
    return float(np.sqrt(max(0.0, x * x + y * y + z * z - along * along)) - tissue.radii[k])


@compiled(nogil=True)
def free_radius(
    tissue: TissuePoints, crossing: Array, direction: Array, extent: Extent, floor: float
) -> float:
    """Distance of the nearest point from an axis; one below ``floor``, once found, ends the search."""
    rooms = np.empty(len(tissue.radii))
    for k in range(len(rooms)):
        rooms[k] = _room(tissue, k, crossing, direction, extent.reach)
    # The block that is likely to hold the nearest point comes first.
    first = int(np.argmin(rooms))
    best = _nearest_in_block(tissue, first, crossing, direction, extent, np.inf)[0]
    for k in range(len(rooms)):
        if best < floor * floor:
            break
        if k != first and (rooms[k] < 0.0 or rooms[k] * rooms[k] < best):
            best = _nearest_in_block(tissue, k, crossing, direction, extent, best)[0]
    return float(np.sqrt(best))


@compiled(nogil=True)
def nearest_points(
    tissue: TissuePoints, crossing: Array, direction: Array, extent: Extent, limit: float
) -> IntArray:
    """The points nearer to an axis than ``limit`` [m], nearest first; of many the nearest of each block."""
    found, blocks, many = np.empty(_MOST_POINTS, np.int64), np.empty(len(tissue.radii), np.int64), False
    count, blocked, least = 0, 0, np.inf
    for k in range(len(blocks)):
        if not _room(tissue, k, crossing, direction, extent.reach) < limit:
            continue
        squared, index = _nearest_in_block(tissue, k, crossing, direction, extent, limit * limit)
        if index < 0:
            continue
        blocks[blocked] = index
        if squared < least:
            least = squared
            blocks[blocked], blocks[0] = blocks[0], index
        blocked += 1
        for i in range(tissue.starts[k], tissue.starts[k + 1]):
            if many or i == index or not _counts(tissue, i, crossing, direction, extent, limit):
                continue
            found[count] = i
            count += 1
            many = count == _MOST_POINTS
    if many:
        return blocks[:blocked]
    return np.concatenate((blocks[:blocked], found[:count]))


@compiled(nogil=True)
def _counts(
    tissue: TissuePoints, i: int, crossing: Array, direction: Array, extent: Extent, limit: float
) -> bool:
    """Whether a point counts and is nearer to an axis than ``limit`` [m]."""
    points, v = tissue.points, extent.viewing
    x, y, z = points[i, 0] - crossing[0], points[i, 1] - crossing[1], points[i, 2] - crossing[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    x, y, z = x - along * direction[0], y - along * direction[1], z - along * direction[2]
    depth = points[i, 0] * v[0] + points[i, 1] * v[1] + points[i, 2] * v[2]
    near = x * x + y * y + z * z < limit * limit
    return bool(near and abs(along) <= extent.reach and depth >= extent.lens)
