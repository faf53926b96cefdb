"""Silhouette edges of a surface: where the lines of sight of a lens can touch it."""

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.anatomy.meshes import Surface

_REACH = 0.06  # [m]: farther edges bound no opening


class Silhouette:
    """The edges of a surface and the triangles on both sides of each."""

    def __init__(self, surface: Surface) -> None:
        faces = surface.faces
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        owners = np.repeat(np.arange(len(faces)), 3)
        order = np.lexsort((owners, edges[:, 1], edges[:, 0]))
        edges, owners = edges[order], owners[order]
        first = np.flatnonzero(np.append(True, (np.diff(edges, axis=0) != 0).any(axis=1)))
        last = np.append(first[1:], len(edges)) - 1
        self._ends = surface.vertices[edges[first]]
        # A border has one triangle only and is always an edge.
        self._border = first == last
        self._faces: npt.NDArray[np.int64] = np.stack([owners[first], owners[last]], axis=-1)
        corners = surface.corners
        self._normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._places = corners[:, 0]

    def touched(self, origin: Array, direction: Array) -> tuple[Array, float]:
        """The point (3,) of the silhouette nearest to a line of sight by angle, and that angle [rad]."""
        facing = np.einsum("ij,ij->i", self._normals, origin - self._places) > 0.0
        shown = self._border | (facing[self._faces[:, 0]] != facing[self._faces[:, 1]])
        ends = self._ends[shown] - origin
        along = ends @ direction
        ends = ends[(along > 0.0).all(axis=1) & (along < _REACH).all(axis=1)]
        if not len(ends):
            return origin - direction, float(np.pi)
        # In the plane across the line, at unit distance, edges are straight lines.
        flat = ends / (ends @ direction)[..., None] - direction
        start, side = flat[:, 0], flat[:, 1] - flat[:, 0]
        length = np.maximum(np.einsum("ij,ij->i", side, side), 1e-30)
        share = np.clip(-np.einsum("ij,ij->i", start, side) / length, 0.0, 1.0)
        off = np.linalg.norm(start + share[:, None] * side, axis=1)
        best = int(np.argmin(off))
        # The share is of the picture; in space it is another.
        near, far = (float(ends[best, k] @ direction) for k in (0, 1))
        placed = share[best] * near / (share[best] * near + (1.0 - share[best]) * far)
        point = origin + ends[best, 0] + placed * (ends[best, 1] - ends[best, 0])
        return point, float(np.arctan(off[best]))
