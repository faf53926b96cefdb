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

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.surfaces.linear_programme import highest
from knee_gap_simulation.surfaces.tissue_points import Extent, TissuePoints, free_radius, nearest_points, scan

# Half angle of the cone about the direction of view that contains the instrument's direction [rad].
CONE = float(np.radians(10.0))
# Length along the axis before and behind the section over which the instrument touches no tissue [m].
REACH = 0.010

_RINGS = 6  # rings of tilts in the scan
_STARTS = 5  # maxima of the scan that are followed
_LEVER = 5.0e-3  # [m]: a tilt counts as much as a shift of the axis at this distance
_TRUST = 0.4e-3  # initial trust region [m]
_LEAST_TRUST = 2e-8  # trust region [m] at which the search stops
_ROUNDS = 60
_TANGENTS = 24  # of the cone, in the linear programme


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
    search = _Search(points, edges, Extent(reach, view, depth), cone)
    best, place = max((search.refined(start) for start in search.scanned()), key=lambda found: found[0])
    crossing, direction = search.axis(place)
    return InstrumentGap(2.0 * best, crossing, direction)


class _Search:
    """The search for one section.

    A place (3,) is the crossing's distance from the first edge [m], and two tilts times ``_LEVER`` [m].
    """

    def __init__(self, tissue: TissuePoints, edges: Array, extent: Extent, cone: float) -> None:
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
            best, crossing = scan(
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
        best, trust = free_radius(self._tissue, *self.axis(place), self._extent, 0.0), _TRUST
        for _ in range(_ROUNDS):
            proposed = self._proposed(place, best, trust)
            free = free_radius(self._tissue, *self.axis(proposed), self._extent, best)
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
        nearest = nearest_points(self._tissue, crossing, direction, self._extent, free + 6.0 * trust)
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
        proposed = place + trust * highest(rows, limits)[:3]
        tilt = float(np.linalg.norm(proposed[1:]))
        if tilt > self._most:
            proposed[1:] *= self._most / tilt
        proposed[0] = min(max(proposed[0], 0.0), self._width)
        return np.asarray(proposed)
