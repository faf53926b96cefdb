"""Ground truth of one section of an opening: its edges, its instrument gap, and other widths."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.shape import KneeShape
from knee_gap_simulation.rims.scene import RimScene
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.instrument_gap import CONE, InstrumentGap, instrument_gap
from knee_gap_simulation.surfaces.tissue_points import TissuePoints
from knee_gap_simulation.surfaces.tissue_samples import LOWER_SIDE, UPPER_SIDE, TissueSamples

Scene = RimScene | KneeShape

# Distance from the plane of the section within which tissue counts for the nearest distance of the sides [m].
NEAR_SECTION = 0.5e-3

# Edges [rad] that are nearer to each other bound nothing; lines of sight farther off all tissue are no edges.
_LEAST_APART = float(np.radians(0.5))
_MOST_MISSED = float(np.radians(8.0))
_GRID = 0.004  # [m]: sections whose middles lie in one cell of it share their samples of the tissue
# How wide [m] a section may be, and how far [m] around the middle of its cell the tissue is then sampled.
_REACHES = ((0.012, 0.018), (0.020, 0.028))
_DIRECTIONS = 64
_STEP_PX = 3.0


class SectionTruth(NamedTuple):
    """Ground truth of one section. Lengths [m], points and directions in the frame of the given lens pose.

    edge_points (2, 3): the points that the edges' viewing rays touch. instrument: the instrument gap.
    along_view: the same with the axis along the direction of view. edge_distance: between the edge points.
    across_view: that distance across the view, (r0 + r1) sin(half the angle between the edges) with the
    ranges r. nearest_distance: the least between the two sides within ``NEAR_SECTION`` of the section, NaN if
    one of them is not there.
    """

    edge_points: Array
    instrument: InstrumentGap
    along_view: InstrumentGap
    edge_distance: float
    across_view: float
    nearest_distance: float

    def moved(self, T_a_b: Array) -> "SectionTruth":
        """The same, of frame b, in frame a."""
        return self._replace(
            edge_points=self.edge_points @ T_a_b[:3, :3].T + T_a_b[:3, 3],
            instrument=self.instrument.moved(T_a_b),
            along_view=self.along_view.moved(T_a_b),
        )


def edge_contacts(scene: Scene, T_scene_lens: Array, edge_bearings: npt.ArrayLike) -> Array:
    """The points (2, 3) of the two sides that the lines of sight along two edges (2, 3) of a lens touch.

    A line that misses or cuts its side is taken to the point of the side to which it comes closest, so that
    the points follow the bearings without jumps.
    """
    bearings = np.asarray(edge_bearings, dtype=np.float64).reshape(2, 3)
    if not np.isfinite(bearings).all() or not (np.linalg.norm(bearings, axis=1) > 0.0).all():
        raise SimulationError(f"the bearings of the edges must be finite vectors, not {bearings.tolist()}")
    directions = bearings / np.linalg.norm(bearings, axis=1)[:, None] @ T_scene_lens[:3, :3].T
    apart = float(np.arctan2(np.linalg.norm(np.cross(*directions)), directions[0] @ directions[1]))
    if apart < _LEAST_APART:
        raise SimulationError(f"the edges lie {np.degrees(apart):.2f} degrees apart: they bound no opening")
    (points_0, off_0), (points_1, off_1) = (
        scene.contacts(T_scene_lens[:3, 3], direction) for direction in directions
    )
    # One edge on each side, in the order that moves the lines of sight least: also where they miss narrowly.
    straight = bool(off_0[0] + off_1[1] <= off_0[1] + off_1[0])
    first, second = (0, 1) if straight else (1, 0)
    missed = max(float(off_0[first]), float(off_1[second]))
    if missed > _MOST_MISSED:
        raise SimulationError(f"an edge lies {np.degrees(missed):.1f} degrees off all tissue: not an edge")
    return np.stack([points_0[first], points_1[second]])


def view_between(T_scene_lens: Array, edge_bearings: npt.ArrayLike) -> Array:
    """Direction of view (3,) in the scene, through the middle between two edges (2, 3) of a lens."""
    bearings = np.asarray(edge_bearings, dtype=np.float64).reshape(2, 3)
    middle = (bearings / np.linalg.norm(bearings, axis=1)[:, None]).sum(axis=0)
    return np.asarray(T_scene_lens[:3, :3] @ (middle / np.linalg.norm(middle)))


def true_instrument_gap(
    scene: Scene, T_scene_lens: Array, edge_bearings: npt.ArrayLike, *, cone: float = CONE
) -> InstrumentGap:
    """The instrument gap of the section between two edges (2, 3), bearings of a lens; in the scene."""
    edges = edge_contacts(scene, T_scene_lens, edge_bearings)
    view = view_between(T_scene_lens, edge_bearings)
    return instrument_gap(_tissue(scene, edges), edges, view, lens=T_scene_lens[:3, 3], cone=cone)


def section_truth(scene: Scene, T_scene_lens: Array, edge_bearings: npt.ArrayLike) -> SectionTruth:
    """Ground truth of the section between two edges (2, 3), bearings of a lens; in the scene."""
    edges = edge_contacts(scene, T_scene_lens, edge_bearings)
    view, lens = view_between(T_scene_lens, edge_bearings), T_scene_lens[:3, 3]
    tissue = _tissue(scene, edges)
    aside = edges - lens
    aside -= (aside @ view)[:, None] * view
    return SectionTruth(
        edges,
        instrument_gap(tissue, edges, view, lens=lens),
        instrument_gap(tissue, edges, view, lens=lens, cone=0.0),
        float(np.linalg.norm(edges[1] - edges[0])),
        float(np.linalg.norm(aside, axis=1).sum()),
        _nearest_sides(scene, edges, view),
    )


def edges_at_section(
    scene: Scene,
    lens: Lens,
    T_scene_lens: Array,
    pixel: npt.ArrayLike,
    across_direction: npt.ArrayLike | None = None,
) -> Array:
    """True bearings (2, 3) of the edges on the line across the opening through a pixel (2,) [px] in it.

    ``across_direction`` (2,) is in the image; by default, the direction of the narrowest opening. The first
    edge is the one from which the direction points away; by default, the upper one in the scene. NaN if the
    pixel is not in the gap, or if the line leaves the field of view before it meets an edge.
    """
    at = np.asarray(pixel, dtype=np.float64).reshape(2)
    unknown = np.full((2, 3), np.nan)
    if not _open(scene, lens, T_scene_lens, at[None])[0]:
        return unknown
    if across_direction is None:
        angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
        lengths = _spokes(scene, lens, T_scene_lens, at, angles)
        half = _DIRECTIONS // 2
        best = float(angles[int(np.argmin(lengths[:half] + lengths[half:]))])
        # Refine the narrowest direction to a hundredth of the fan's step.
        for step in (0.5, 0.1, 0.02):
            fan = best + np.arange(-4, 5) * step * 0.5 * np.pi / half
            lengths = _spokes(scene, lens, T_scene_lens, at, np.concatenate([fan, fan + np.pi]))
            best = float(fan[int(np.argmin(lengths[:9] + lengths[9:]))])
    else:
        direction = np.asarray(across_direction, dtype=np.float64).reshape(2)
        if not np.isfinite(direction).all() or not direction.any():
            raise SimulationError(f"the direction across the opening must be a vector, not {direction}")
        best = float(np.arctan2(direction[1], direction[0]))
    ends = np.array([best + np.pi, best])
    lengths = _spokes(scene, lens, T_scene_lens, at, ends)
    if not np.isfinite(lengths).all():
        return unknown
    bearings = lens.bearings(at + lengths[:, None] * np.stack([np.cos(ends), np.sin(ends)], axis=-1))
    if across_direction is None and (bearings @ T_scene_lens[1, :3])[0] > (bearings @ T_scene_lens[1, :3])[1]:
        bearings = bearings[::-1]
    return np.asarray(bearings)


def _spokes(scene: Scene, lens: Lens, T_scene_lens: Array, at: Array, angles: Array) -> Array:
    """Distance (n,) [px] from a pixel to the edge in directions (n,) [rad]; infinite if there is none."""
    units = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    radii = np.arange(_STEP_PX, 2.0 * lens.radius_px, _STEP_PX)
    far = np.full(len(angles), np.inf)
    for k in range(len(angles)):
        # Piece by piece, since most spokes are short.
        for piece in np.split(radii, range(40, len(radii), 40)):
            pixels = at + piece[:, None] * units[k]
            seen = np.isfinite(lens.bearings(pixels)[:, 0])
            ends = np.flatnonzero(~_open(scene, lens, T_scene_lens, pixels))
            if ends.size:
                far[k] = piece[ends[0]] if seen[ends[0]] else np.inf
                break
    known = np.flatnonzero(np.isfinite(far))
    low, high = far[known] - _STEP_PX, far[known]
    for _ in range(30):
        middle = 0.5 * (low + high)
        is_open = _open(scene, lens, T_scene_lens, at + middle[:, None] * units[known])
        low, high = np.where(is_open, middle, low), np.where(is_open, high, middle)
    far[known] = 0.5 * (low + high)
    return far


def _open(scene: Scene, lens: Lens, T_scene_lens: Array, pixels: Array) -> npt.NDArray[np.bool_]:
    """Whether pixels (n, 2) look into the gap, ignoring probe and debris; false outside the field of view."""
    bearings = lens.bearings(pixels)
    seen = np.isfinite(bearings[:, 0])
    result = np.zeros(len(pixels), bool)
    if seen.any():
        result[seen] = scene.looks_into_gap(T_scene_lens, bearings[seen])
    return result


def _place(edges: Array) -> tuple[int, int, int, float]:
    """Grid cell of a section, and the radius around its middle in which tissue matters."""
    width = float(np.linalg.norm(edges[1] - edges[0]))
    for widest, reach in _REACHES:
        if width <= widest:
            x, y, z = np.round(edges.mean(axis=0) / _GRID)
            return int(x), int(y), int(z), reach
    raise SimulationError(
        f"edges {1e3 * width:.1f} mm apart do not bound a gap: more than {1e3 * widest:g} mm"
    )


def _tissue(scene: Scene, edges: Array) -> TissuePoints:
    return _sorted_samples(scene, *_place(edges))


@lru_cache(maxsize=6)
def _samples(scene: Scene, x: int, y: int, z: int, reach: float) -> TissueSamples:
    return scene.tissue_samples(_GRID * np.array([x, y, z], dtype=np.float64), reach)


@lru_cache(maxsize=6)
def _sorted_samples(scene: Scene, x: int, y: int, z: int, reach: float) -> TissuePoints:
    return TissuePoints.of(_samples(scene, x, y, z, reach).points)


def _nearest_sides(scene: Scene, edges: Array, view: Array) -> float:
    """Least distance [m] between the two sides near the plane of a section."""
    samples = _samples(scene, *_place(edges))
    normal = np.cross(edges[1] - edges[0], view)
    normal /= np.linalg.norm(normal)
    near = np.abs((samples.points - edges[0]) @ normal) <= NEAR_SECTION
    upper, lower = (samples.points[near & (samples.sides == side)] for side in (UPPER_SIDE, LOWER_SIDE))
    if not (len(upper) and len(lower)):
        return float("nan")
    return float(cKDTree(upper).query(lower)[0].min())
