"""The instrument gap: the diameter of the thickest straight instrument that passes between points of tissue.

    D = max over s, u of 2 min over p of |(p - c) - ((p - c) . u) u|,   c = E0 + s (E1 - E0)

c is where the axis of the instrument crosses the section E0 E1 of the opening, u its direction within a cone
about the direction of view v, and p any point of tissue at most ``REACH`` before or behind the section along
the axis and not before the lens. The tissue is given as a set of points on it, so any scene that can be
sampled, a mesh for example, has an instrument gap.

The maximum is found by a scan over s and two tilts, followed by sequential linear programming: the distances
of the nearest points are linearised within a trust region, which shrinks if a step does not improve the gap.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError

IntArray = npt.NDArray[np.int64]

# Half angle of the cone about the direction of view that contains the instrument's direction [rad].
CONE = float(np.radians(10.0))
# Length along the axis before and behind the section over which the instrument touches no tissue [m].
REACH = 0.010

_BLOCK = 1.0e-3  # edge [m] of the cubes into which points are sorted
_CROSSINGS = 11  # positions of the axis on the section in the scan
_CROSSING_STEP = 1e-6  # [m]: accuracy of each tilt's best position
_RINGS = 6  # rings of tilts in the scan
_STARTS = 5  # maxima of the scan that are followed
_LEVER = 5.0e-3  # [m]: a tilt counts as much as a shift of the axis at this distance
_TRUST = 0.4e-3  # initial trust region [m]
_LEAST_TRUST = 2e-8  # trust region [m] at which the search stops
_ROUNDS = 60
_TANGENTS = 24  # of the cone, in the linear programme
_MOST_POINTS = 1500  # in the linear programme


class InstrumentGap(NamedTuple):
    """The thickest instrument: its diameter [m], a point (3,) [m] and the direction (3,) of its axis.

    The point is where the axis crosses the section, and the direction leads away from the lens.
    """

    diameter: float
    axis_point: Array
    axis_direction: Array

    def moved(self, T_a_b: Array) -> "InstrumentGap":
        """The same instrument, of frame b, in frame a."""
        turn = T_a_b[:3, :3]
        return InstrumentGap(self.diameter, turn @ self.axis_point + T_a_b[:3, 3], turn @ self.axis_direction)


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


class _Extent(NamedTuple):
    """Region in which tissue counts: within ``reach`` [m] of the section along an axis, not before the lens.

    The lens is at a depth of ``lens`` [m] along the direction of view (3,).
    """

    reach: float
    viewing: Array
    lens: float


def instrument_gap(
    tissue: npt.ArrayLike | TissuePoints,
    edge_points: npt.ArrayLike,
    view_direction: npt.ArrayLike,
    *,
    lens: npt.ArrayLike | None = None,
    cone: float = CONE,
    reach: float = REACH,
) -> InstrumentGap:
    """The thickest instrument through the section between two points of tissue ``edge_points`` (2, 3) [m].

    ``tissue``: points (n, 3) [m] on all surfaces around. They must be so dense that their spacing does not
    matter: h apart, they make a gap D too wide by up to about h^2 / (2 D) on an even surface.
    ``view_direction`` (3,) of any length. ``lens`` (3,): tissue before the plane through it, perpendicular to
    the view, does not count. ``cone`` [rad]; 0: along the view only. All in one frame, which is that of the
    answer too. Raises SimulationError for edges that are one point, a view along the section, and a cone
    outside [0, pi/3].
    """
    points = tissue if isinstance(tissue, TissuePoints) else TissuePoints.of(tissue)
    edges = np.asarray(edge_points, dtype=np.float64).reshape(2, 3)
    view = np.asarray(view_direction, dtype=np.float64).reshape(3)
    width, length = float(np.linalg.norm(edges[1] - edges[0])), float(np.linalg.norm(view))
    if not (1e-6 < width < 1.0 and 0.0 < length < np.inf):
        raise SimulationError(f"no section of an opening: edges {width:g} m apart, view {view.tolist()}")
    if not (0.0 <= cone <= np.pi / 3.0 and 0.0 < reach < 1.0):
        raise SimulationError(f"the cone must lie in [0, pi/3] rad, the reach in (0, 1) m: {cone}, {reach}")
    view = view / length
    depth = -np.inf if lens is None else float(view @ np.asarray(lens, dtype=np.float64))
    search = _Search(points, edges, _Extent(reach, view, depth), cone)
    best, place = max((search.refined(start) for start in search.scanned()), key=lambda found: found[0])
    crossing, direction = search.axis(place)
    return InstrumentGap(2.0 * best, crossing, direction)


class _Search:
    """The search for one section.

    A place (3,) is the crossing's distance from the first edge [m], and two tilts times ``_LEVER`` [m].
    """

    def __init__(self, tissue: TissuePoints, edges: Array, extent: _Extent, cone: float) -> None:
        view = extent.viewing
        self._extent, self._start = extent, edges[0]
        self._width = float(np.linalg.norm(edges[1] - edges[0]))
        self._across = (edges[1] - edges[0]) / self._width
        within = self._across - (self._across @ view) * view
        if not np.linalg.norm(within) > 1e-3:
            raise SimulationError("the direction of view lies along the section: no instrument passes there")
        within /= np.linalg.norm(within)
        # The first tilt turns the axis along the opening, the second within the section's plane.
        self._tilts = np.stack([np.cross(view, within), within])
        self._most = float(_LEVER * np.tan(cone))
        # No instrument is thicker than the distance between the edges: they are tissue themselves.
        radius = self._width + 1.05 * extent.reach * np.tan(cone)
        far = (extent.reach + self._width) / np.cos(cone)
        near, own = tissue.around(edges.mean(axis=0), view, radius, far), TissuePoints.of(edges)
        self._tissue = TissuePoints(
            np.concatenate([own.points, near.points]),
            np.concatenate([own.starts, near.starts[1:] + own.starts[-1]]),
            np.concatenate([own.centres, near.centres]),
            np.concatenate([own.radii, near.radii]),
        )

    def axis(self, place: Array) -> tuple[Array, Array]:
        """Crossing (3,) and direction (3,) of the axis at a place."""
        direction = self._extent.viewing + (place[1:] / _LEVER) @ self._tilts
        return self._start + place[0] * self._across, direction / np.linalg.norm(direction)

    def scanned(self) -> list[Array]:
        """The most promising places of a scan, their tilts more than a ring apart."""
        tilts = [np.zeros((1, 2))]
        for ring in range(1, _RINGS + 1 if self._most > 0.0 else 1):
            angles = np.arange(6 * ring) * (np.pi / (3 * ring))
            tilts.append(self._most * ring / _RINGS * np.stack([np.cos(angles), np.sin(angles)], axis=-1))
        places: list[Array] = []
        free: list[float] = []
        for tilt in np.concatenate(tilts):
            direction = self.axis(np.array([0.0, *tilt]))[1]
            best, crossing = _scan(
                self._tissue, self._start, self._across, self._width, direction, self._extent
            )
            places.append(np.array([crossing, *tilt]))
            free.append(best)
        starts: list[Array] = []
        for index in np.argsort(free)[::-1]:
            apart = [float(np.linalg.norm((places[index] - start)[1:])) for start in starts]
            if min(apart, default=np.inf) > 1.5 * self._most / _RINGS:
                starts.append(places[index])
        return starts[:_STARTS]

    def refined(self, place: Array) -> tuple[float, Array]:
        """Largest free radius [m] found from a starting place, and its place."""
        best, trust = _free_radius(self._tissue, *self.axis(place), self._extent, 0.0), _TRUST
        for _ in range(_ROUNDS):
            proposed = self._proposed(place, best, trust)
            free = _free_radius(self._tissue, *self.axis(proposed), self._extent, best)
            if free > best:
                trust = trust if free - best > 0.1 * trust else 0.5 * trust
                best, place = free, proposed
            else:
                trust *= 0.3
            if trust < _LEAST_TRUST:
                break
        return best, place

    def _proposed(self, place: Array, free: float, trust: float) -> Array:
        """Best place within the trust region by the linearised distances."""
        crossing, direction = self.axis(place)
        nearest = _nearest_points(self._tissue, crossing, direction, self._extent, free + 6.0 * trust)
        away = self._tissue.points[nearest] - crossing
        along = away @ direction
        aside = away - along[:, None] * direction
        distances = np.linalg.norm(aside, axis=1)
        normals = aside / np.maximum(distances, 1e-12)[:, None]
        stretch = _LEVER * np.linalg.norm(self._extent.viewing + (place[1:] / _LEVER) @ self._tilts)
        slopes = np.column_stack(
            [normals @ self._across, (along / stretch)[:, None] * (normals @ self._tilts.T)]
        )
        low, high = np.full(3, -trust), np.full(3, trust)
        low[0], high[0] = max(low[0], -place[0]), min(high[0], self._width - place[0])
        if not self._most > 0.0:
            low[1:] = high[1:] = 0.0
        # The cone as its tangents, one of them at the place itself; the rest is cut off below.
        angles = np.arctan2(place[2], place[1]) + np.arange(_TANGENTS) * (2.0 * np.pi / _TANGENTS)
        tangents = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        rows = np.zeros((6 + len(distances) + _TANGENTS, 4))
        rows[:3, :3], rows[3:6, :3] = np.eye(3), -np.eye(3)
        rows[6:-_TANGENTS, :3], rows[6:-_TANGENTS, 3] = slopes, 1.0
        rows[-_TANGENTS:, 1:3] = tangents
        # By rounding, a place at the border may lie beyond a tangent; the box's corner must not.
        room = np.maximum(self._most - tangents @ place[1:], 0.0)
        # In units of the trust region, so that tolerances mean the same in every round.
        limits = np.concatenate([high, -low, distances - free, room]) / trust
        proposed = place + trust * _highest(rows, limits)[:3]
        tilt = float(np.linalg.norm(proposed[1:]))
        if tilt > self._most:
            proposed[1:] *= self._most / tilt
        proposed[0] = min(max(proposed[0], 0.0), self._width)
        return np.asarray(proposed)


@compiled(nogil=True)
def _highest(rows: Array, limits: Array) -> Array:
    """The x (4,) with the greatest x[3] of all with rows @ x <= limits, (m, 4) and (m,).

    The first six rows must be the upper and the lower bounds of x[0] to x[2], the seventh must bound x[3].
    The dual programme by the simplex method; a basis is four rows, which meet in x.
    """
    basis = np.array([0, 1, 2, 6])
    inverse = np.eye(4)  # of the rows of the basis
    for k in range(3):
        # The bound against which the seventh row pushes.
        if rows[6, k] > 0.0:
            basis[k] = 3 + k
            inverse[k, k] = -1.0
        inverse[3, k] = -rows[6, k] * inverse[k, k]
    x, change = np.zeros(4), np.zeros(4)
    for _ in range(400):
        for j in range(4):
            x[j] = 0.0
            for k in range(4):
                x[j] += inverse[j, k] * limits[basis[k]]
        entering, worst = -1, -1e-9
        for i in range(rows.shape[0]):
            room = limits[i]
            for k in range(4):
                room -= rows[i, k] * x[k]
            if room < worst:
                entering, worst = i, room
        if entering < 0:
            break
        leaving, least = -1, np.inf
        for k in range(4):
            change[k] = 0.0
            for j in range(4):
                change[k] += inverse[j, k] * rows[entering, j]
            if change[k] > 1e-12 and inverse[3, k] / change[k] < least:
                leaving, least = k, inverse[3, k] / change[k]
        if leaving < 0:
            break
        basis[leaving] = entering
        for j in range(4):
            inverse[j, leaving] /= change[leaving]
            for k in range(4):
                if k != leaving:
                    inverse[j, k] -= inverse[j, leaving] * change[k]
    return x


@compiled(nogil=True)
def _scan(
    tissue: TissuePoints,
    start: Array,
    across: Array,
    width: float,
    direction: Array,
    extent: _Extent,
) -> tuple[float, float]:
    """Largest free radius of parallel axes that cross the section, and the place of the crossing [m]."""
    best, crossing = 0.0, 0.5 * width
    for k in range(_CROSSINGS):
        s = width * (k + 0.5) / _CROSSINGS
        free = _free_radius(tissue, start + s * across, direction, extent, best)
        if free > best:
            best, crossing = free, s
    # On one side the tissue above is nearest, on the other the tissue below: bisect for the best place.
    step = width / _CROSSINGS
    while step > _CROSSING_STEP:
        step *= 0.5
        for s in (crossing - step, crossing + step):
            free = _free_radius(tissue, start + s * across, direction, extent, best)
            if free > best:
                best, crossing = free, s
    return best, crossing


@compiled(nogil=True)
def _nearest_in_block(
    tissue: TissuePoints, k: int, crossing: Array, direction: Array, extent: _Extent, best: float
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
def _free_radius(
    tissue: TissuePoints, crossing: Array, direction: Array, extent: _Extent, floor: float
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
def _nearest_points(
    tissue: TissuePoints, crossing: Array, direction: Array, extent: _Extent, limit: float
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
    tissue: TissuePoints, i: int, crossing: Array, direction: Array, extent: _Extent, limit: float
) -> bool:
    """Whether a point counts and is nearer to an axis than ``limit`` [m]."""
    points, v = tissue.points, extent.viewing
    x, y, z = points[i, 0] - crossing[0], points[i, 1] - crossing[1], points[i, 2] - crossing[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    x, y, z = x - along * direction[0], y - along * direction[1], z - along * direction[2]
    depth = points[i, 0] * v[0] + points[i, 1] * v[1] + points[i, 2] * v[2]
    near = x * x + y * y + z * z < limit * limit
    return bool(near and abs(along) <= extent.reach and depth >= extent.lens)
