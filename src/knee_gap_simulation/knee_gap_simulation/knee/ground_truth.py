"""Ground truth of the knee: surface points behind pixels, and their positions in later frames."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeKind
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.knee.shape import KneeShape
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.distance_field import CONDYLE, MENISCUS, PROBE

# A point is visible if its ray ends this close to it [m]: whatever hides it is farther in front.
_SAME_POINT = 30e-6
# Radius around a point within which its nearest edge is searched.
EDGE_REACH_PX = 80.0
_DIRECTIONS = 64
_RING_PX = 3.0


class Visibility(IntEnum):
    """Whether a surface point is visible in a frame, or why not."""

    VISIBLE = 0
    OUT_OF_VIEW = 1
    BEHIND_TISSUE = 2
    BEHIND_PROBE = 3
    BEHIND_DEBRIS = 4


class SurfacePoints(NamedTuple):
    """Points (n, 3) in the world [m], unit normals (n, 3), and their surfaces (n,), 255 for none."""

    points: Array
    normals: Array
    surfaces: npt.NDArray[np.uint8]


class PointObservations(NamedTuple):
    """The same n points in one frame.

    pixels (n, 2): positions, visible or hidden; NaN outside the field of view. visibility (n,).
    contour_offset_px (n,): distance to the nearest edge of the gap in this frame without probe and debris,
    negative for a pixel inside the gap; NaN beyond 80 px. contour_offset (n,): the same as an angle [rad].
    edge_kinds (n,): kind of that edge.
    """

    pixels: Array
    visibility: npt.NDArray[np.uint8]
    contour_offset_px: Array
    contour_offset: Array
    edge_kinds: npt.NDArray[np.uint8]

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Whether each point (n,) is visible."""
        return np.asarray(self.visibility == Visibility.VISIBLE)


def surface_points(
    scene: KneeShape,
    lens: Lens,
    T_world_scene: Array,
    T_world_lens: Array,
    probe: Array,
    pixels: npt.ArrayLike,
) -> SurfacePoints:
    """Surface points behind pixels (n, 2) [px] of a frame; NaN outside the field of view."""
    bearings = lens.bearings(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
    T_scene_lens = inverse(T_world_scene) @ T_world_lens
    turn = T_world_scene[:3, :3]
    points, normals, surfaces, _ = scene.cast(T_scene_lens[:3, 3], bearings @ T_scene_lens[:3, :3].T, probe)
    return SurfacePoints(points @ turn.T + T_world_scene[:3, 3], normals @ turn.T, surfaces)


def follow(
    scene: KneeShape,
    lens: Lens,
    T_world_scene: Array,
    T_world_lens: Array,
    probe: Array,
    debris_cover: npt.NDArray[np.float32],
    points: SurfacePoints,
    *,
    edges: bool = True,
) -> PointObservations:
    """Positions of surface points in a frame with a true lens pose, a probe and debris.

    If ``edges`` is False, the nearest edges are left out (NaN, UNKNOWN); they take most of the time.
    """
    T_scene_lens = inverse(T_world_scene) @ T_world_lens
    T_lens_world = inverse(T_world_lens)
    in_lens = points.points @ T_lens_world[:3, :3].T + T_lens_world[:3, 3]
    pixels, far = lens.pixels(in_lens), np.linalg.norm(in_lens, axis=-1)
    directions = (in_lens / far[:, None]) @ T_scene_lens[:3, :3].T
    _, _, hit, lengths = scene.cast(T_scene_lens[:3, 3], directions, probe)
    visibility = np.full(len(far), Visibility.VISIBLE, np.uint8)
    covered = _sample(debris_cover, pixels) > 0.5
    visibility[covered] = Visibility.BEHIND_DEBRIS
    hidden = lengths < far - _SAME_POINT
    visibility[hidden] = Visibility.BEHIND_TISSUE
    visibility[hidden & (hit == PROBE)] = Visibility.BEHIND_PROBE
    visibility[~np.isfinite(pixels[:, 0])] = Visibility.OUT_OF_VIEW
    offsets = np.full((len(far), 2), np.nan)
    kinds = np.full(len(far), EdgeKind.UNKNOWN, np.uint8)
    for index in np.flatnonzero(np.isfinite(pixels[:, 0]) & edges):
        offsets[index], kinds[index] = nearest_edge(scene, lens, T_scene_lens, pixels[index])
    return PointObservations(pixels, visibility, offsets[:, 0], offsets[:, 1], kinds)


def nearest_edge(scene: KneeShape, lens: Lens, T_scene_lens: Array, pixel: Array) -> tuple[Array, EdgeKind]:
    """Distance ([px], [rad]) from a pixel to the nearest edge of the gap, negative inside, and its kind."""
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    inside = bool(scene.looks_into_gap(T_scene_lens, lens.bearings(pixel[None]))[0])
    # Search in growing rings until one meets the other side; the edge lies between it and the last ring.
    for radius in np.arange(_RING_PX, EDGE_REACH_PX + _RING_PX, _RING_PX):
        ring = scene.looks_into_gap(T_scene_lens, lens.bearings(pixel + radius * spokes)) != inside
        if ring.any():
            break
    else:
        return np.array([np.nan, np.nan]), EdgeKind.UNKNOWN
    candidates = np.flatnonzero(ring)
    near, far = np.full(len(candidates), radius - _RING_PX), np.full(len(candidates), radius)
    for _ in range(12):
        middle = 0.5 * (near + far)
        pixels = pixel + middle[:, None] * spokes[candidates]
        crossed = scene.looks_into_gap(T_scene_lens, lens.bearings(pixels)) != inside
        near, far = np.where(crossed, near, middle), np.where(crossed, middle, far)
    best = int(np.argmin(far))
    spoke = spokes[candidates[best]]
    tissue_side = pixel + (far[best] if inside else near[best]) * spoke
    gap_side = pixel + (near[best] if inside else far[best]) * spoke
    kind = _kind(scene, lens, T_scene_lens, tissue_side, gap_side)
    sign = -1.0 if inside else 1.0
    edge = lens.bearings(np.stack([pixel, 0.5 * (tissue_side + gap_side)]))
    angle = float(np.arctan2(np.linalg.norm(np.cross(edge[0], edge[1])), edge[0] @ edge[1]))
    return sign * np.array([far[best], angle]), kind


def _kind(scene: KneeShape, lens: Lens, T_scene_lens: Array, tissue_side: Array, gap_side: Array) -> EdgeKind:
    bearings = lens.bearings(np.stack([tissue_side, gap_side]))
    _, _, surfaces, lengths = scene.cast(T_scene_lens[:3, 3], bearings @ T_scene_lens[:3, :3].T, exact=False)
    # If the surface continues behind the edge, it is the edge of a shadow.
    if not lengths[1] > 1.05 * lengths[0]:
        return EdgeKind.SHADING
    return {CONDYLE: EdgeKind.CONTOUR, MENISCUS: EdgeKind.RIM}.get(int(surfaces[0]), EdgeKind.CONTOUR)


def _sample(image: npt.NDArray[np.float32], pixels: Array) -> Array:
    """The image at the pixels nearest to (n, 2), 0 outside."""
    values = np.zeros(len(pixels))
    finite = np.isfinite(pixels[:, 0])
    columns = np.clip(np.round(pixels[finite, 0]).astype(int), 0, image.shape[1] - 1)
    rows = np.clip(np.round(pixels[finite, 1]).astype(int), 0, image.shape[0] - 1)
    values[finite] = image[rows, columns]
    return values
