"""Rays against triangles: embree finds the triangle, double precision its point."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.anatomy.meshes import Surface
from knee_gap_simulation.errors import SimulationError

# Embree computes in single precision: in these units a knee is a few units wide.
_UNIT = 0.01


class Hits(NamedTuple):
    """First triangles along rays: lengths (n,), NaN for none, faces (n,), -1 for none, weights (n, 3).

    ``inner`` (n,): whether the ray meets the triangle from inside the tissue.
    """

    lengths: Array
    faces: npt.NDArray[np.int64]
    weights: Array
    inner: npt.NDArray[np.bool_]


class RayCaster:
    """Casts rays against one surface."""

    def __init__(self, surface: Surface) -> None:
        try:
            from embreex import mesh_construction, rtcore_scene
        except ImportError:
            raise SimulationError("meshes need trimesh and embreex: run make anatomy") from None
        self._scene: Any = rtcore_scene.EmbreeScene()
        corners = np.ascontiguousarray(surface.corners / _UNIT, dtype=np.float32)
        self._mesh = mesh_construction.TriangleMesh(self._scene, corners)
        self._first = surface.corners[:, 0]
        self._sides = surface.corners[:, 1:] - self._first[:, None]
        self._normals = np.cross(self._sides[:, 0], self._sides[:, 1])

    def cast(self, origin: Array, directions: Array) -> Hits:
        """First triangles along unit directions (n, 3) from one origin (3,)."""
        count = len(directions)
        lengths, weights = np.full(count, np.nan), np.zeros((count, 3))
        faces, inner = np.full(count, -1, np.int64), np.zeros(count, bool)
        known = np.flatnonzero(np.isfinite(directions[:, 0]))
        if len(known) == 0:
            return Hits(lengths, faces, weights, inner)
        rays = np.ascontiguousarray(directions[known], dtype=np.float32)
        starts = np.ascontiguousarray(np.broadcast_to(origin / _UNIT, rays.shape), dtype=np.float32)
        found = np.asarray(self._scene.run(starts, rays)).astype(np.int64)
        hit = known[found >= 0]
        face = found[found >= 0]
        away = self._first[face] - origin
        normals, direction = self._normals[face], directions[hit]
        length = np.einsum("ij,ij->i", away, normals) / np.einsum("ij,ij->i", direction, normals)
        inside = origin + length[:, None] * direction - self._first[face]
        weight = _weights(inside, self._sides[face])
        # Rounding may put a grazing ray's plane far away: keep what lies in its triangle.
        inner[hit] = np.einsum("ij,ij->i", direction, normals) > 0.0
        good = np.isfinite(length) & (length > 0.0) & (weight > -0.05).all(axis=1)
        lengths[hit[good]], faces[hit[good]], weights[hit[good]] = length[good], face[good], weight[good]
        return Hits(lengths, faces, weights, inner)

    def free(self, points: Array, directions: Array, reach: Array) -> npt.NDArray[np.bool_]:
        """Whether nothing is met from points (n, 3) along unit directions (n, 3) within a reach (n,) [m]."""
        starts = np.ascontiguousarray(points / _UNIT, dtype=np.float32)
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        found = np.asarray(self._scene.run(starts, rays)).astype(np.int64)
        hit = np.flatnonzero(found >= 0)
        face = found[hit]
        away, normals = self._first[face] - points[hit], self._normals[face]
        length = np.einsum("ij,ij->i", away, normals) / np.einsum("ij,ij->i", directions[hit], normals)
        result = np.ones(len(points), bool)
        result[hit] = ~(length < reach[hit])
        return result


def _weights(inside: Array, sides: Array) -> Array:
    """Barycentric weights (n, 3) of places (n, 3) from the first corner of triangles with sides (n, 2, 3)."""
    a, b = sides[:, 0], sides[:, 1]
    aa, ab, bb = (np.einsum("ij,ij->i", u, v) for u, v in ((a, a), (a, b), (b, b)))
    pa, pb = np.einsum("ij,ij->i", inside, a), np.einsum("ij,ij->i", inside, b)
    scale = aa * bb - ab * ab
    scale = np.where(np.abs(scale) > 0.0, scale, np.nan)
    u, v = (bb * pa - ab * pb) / scale, (aa * pb - ab * pa) / scale
    return np.stack([1.0 - u - v, u, v], axis=-1)
