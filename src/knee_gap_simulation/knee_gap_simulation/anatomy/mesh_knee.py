"""The scene of a knee made of meshes: one compartment of a posed joint, and a wall of synovium around it.

The scene's frame is that of `KneeScene`: x along the gap, y from femur to tibia, z to the back, the origin in
the middle of the narrowest place. The gap's edges are the contour of the femur and that of what lies below.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.anatomy.meshes import UNITS, KneeMeshes, Surface, read_meshes, sampled
from knee_gap_simulation.anatomy.posing import Compartment, posed
from knee_gap_simulation.anatomy.rays import RayCaster
from knee_gap_simulation.anatomy.rods import rod_hits
from knee_gap_simulation.anatomy.silhouette import Silhouette
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.scene import ANY
from knee_gap_simulation.surfaces.distance_field import CAPSULE, CONDYLE, MENISCUS, PLATEAU, PROBE
from knee_gap_simulation.surfaces.tissue_samples import (
    AROUND,
    LOWER_SIDE,
    SPACING,
    UPPER_SIDE,
    TissueSamples,
    joined,
)

KIND = "meshes"
# A point of the wall deeper than this behind the narrowest place is seen through the gap [m].
BEHIND = 0.0035
_NEAR = 0.3e-3  # spacing [m] of the samples for clearances
_WALL_SPACING = 0.15e-3
# The wall: half width and height around the gap, how far in front, and behind the tissue below [m]: the
# instrument of the true gap reaches 10 mm behind its section and must not meet it.
_ASIDE, _HEIGHT, _BEFORE, _AFTER = 0.0115, 0.022, 0.040, 0.016


class MeshKnee:
    """One compartment of a posed knee of meshes."""

    def __init__(
        self, folder: Path, unit: str, compartment: Compartment, flexion: float, gap: float | None
    ) -> None:
        """Flexion [rad], gap [m] in the compartment, None for a closed joint. Raises SimulationError."""
        if gap is not None and not 0.001 <= gap <= 0.012:
            raise SimulationError(f"the gap must lie in [1, 12] mm, not {1e3 * gap:g} mm")
        meshes: KneeMeshes = read_meshes(folder, unit)
        self.folder, self.unit, self.digest = folder.resolve(), unit, meshes.digest
        self.compartment, self.flexion, self.gap = compartment, flexion, gap
        knee = posed(meshes, compartment, flexion, gap)
        self.tilt, self._nearest = knee.tilt, knee.nearest
        self._parts = (knee.femur, knee.tibia, Surface.joined(list(knee.menisci)))
        whole = Surface.joined(list(self._parts))
        counts = [len(part.faces) for part in self._parts]
        self._surfaces = np.repeat(np.array([CONDYLE, PLATEAU, MENISCUS], np.uint8), counts)
        self._corner_normals = _smooth(whole)
        self._faces = whole.faces
        self.rays = RayCaster(whole)
        below = sampled(knee.tibia, 1e-3)[0]
        below = below[np.abs(below[:, 0]) < _ASIDE]
        behind = float(below[:, 2].max()) + _AFTER
        # Below the plateau there is bone, of which the meshes hold only the cartilage.
        self._floor = float(np.percentile(below[below[:, 2] > 0.0, 1], 90.0))
        self._wall_centre = np.array([0.0, 0.0, 0.5 * (behind - _BEFORE)])
        self._wall_radii = np.array([_ASIDE, _HEIGHT, 0.5 * (behind + _BEFORE)])

    def __eq__(self, other: object) -> bool:
        """Whether both are the same knee, posed in the same way."""
        return isinstance(other, MeshKnee) and self.as_dict() == other.as_dict()

    def __hash__(self) -> int:
        return hash((self.digest, self.compartment, self.flexion, self.gap))

    def as_dict(self) -> dict[str, Any]:
        """The knee as plain values for JSON: the folder of its meshes, their digest, and its pose."""
        return {
            "kind": KIND,
            "folder": str(self.folder),
            "unit": self.unit,
            "digest": self.digest,
            "compartment": str(self.compartment),
            "flexion": self.flexion,
            "gap": self.gap,
        }

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "MeshKnee":
        """The knee of `as_dict`. Raises SimulationError if its meshes are gone or others."""
        if values["unit"] not in UNITS:
            raise SimulationError(f"the unit of meshes must be one of {', '.join(UNITS)}")
        gap = None if values["gap"] is None else float(values["gap"])
        knee = MeshKnee(
            Path(values["folder"]),
            values["unit"],
            Compartment(values["compartment"]),
            float(values["flexion"]),
            gap,
        )
        if knee.digest != values["digest"]:
            raise SimulationError(f"the meshes in {knee.folder} are not those of the bag")
        return knee

    def cast(
        self,
        origin: Array,
        directions: Array,
        probe: Array | None = None,
        *,
        starts: Array | None = None,
        exact: bool = True,
    ) -> tuple[Array, Array, npt.NDArray[np.uint8], Array]:
        """First surface along rays, as `KneeScene.cast`; always exact, and ``starts`` are not needed."""
        hits = self.rays.cast(origin, directions)
        lengths, surfaces = hits.lengths.copy(), np.full(len(directions), 255, np.uint8)
        normals = np.full((len(directions), 3), np.nan)
        hit = hits.faces >= 0
        surfaces[hit] = self._surfaces[hits.faces[hit]]
        normals[hit] = np.einsum("ij,ijk->ik", hits.weights[hit], self._corner_normals[hits.faces[hit]])
        # A surface that is seen from its inner side, beyond a border, has its normal to the viewer too. A
        # smooth normal that turns away from a grazing ray is turned back until it is perpendicular.
        normals[hit] *= np.where(hits.inner[hit], -1.0, 1.0)[:, None]
        along = np.maximum(np.einsum("ij,ij->i", normals, directions), 0.0)
        normals -= along[:, None] * directions
        wall, known = self._wall_lengths(origin, directions), np.isfinite(directions[:, 0])
        # NaN compares as false.
        outside = known & ~(lengths <= wall)
        lengths[outside], surfaces[outside] = wall[outside], CAPSULE
        places = origin + lengths[outside, None] * directions[outside]
        normals[outside] = -(places - self._wall_centre) / self._wall_radii**2
        if probe is not None and len(probe) > 1:
            reached, rod_normals = np.full(len(directions), np.nan), np.zeros((len(directions), 3))
            rod_hits(
                np.ascontiguousarray(origin),
                np.ascontiguousarray(directions),
                lengths,
                probe,
                reached,
                rod_normals,
            )
            met = np.isfinite(reached)
            lengths[met], surfaces[met], normals[met] = reached[met], PROBE, rod_normals[met]
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return origin + lengths[:, None] * directions, normals, surfaces, lengths

    def surface_points(self, T_scene_lens: Array, bearings: Array, probe: Array | None = None) -> Array:
        """Points (n, 3) of the scene behind bearings (n, 3) of a lens; NaN if there are none."""
        return self.cast(T_scene_lens[:3, 3], bearings @ T_scene_lens[:3, :3].T, probe)[0]

    def looks_into_gap(
        self, T_scene_lens: Array, bearings: Array, probe: Array | None = None
    ) -> npt.NDArray[np.bool_]:
        """Whether bearings (n, 3) of a lens look into the gap."""
        points, _, surfaces, _ = self.cast(T_scene_lens[:3, 3], bearings @ T_scene_lens[:3, :3].T, probe)
        return self.is_gap(points, surfaces)

    def is_gap(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Whether points (n, 3) on surfaces (n,) were seen through the gap: on the wall behind it."""
        above = points[:, 1] < self._floor
        return np.asarray((surfaces == CAPSULE) & (points[:, 2] > BEHIND) & above)

    def uv(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> Array:
        """Coordinates (n, 2) [m] on the surface of points (n, 3), for the textures."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        uv = np.stack([x, z], axis=-1)
        on = surfaces == CONDYLE
        uv[on, 1] = 0.021 * np.arctan2(z[on], y[on] + 0.022)
        on = surfaces == MENISCUS
        uv[on, 1] = 0.7 * (z[on] - y[on])
        on = surfaces == CAPSULE
        uv[on, 0] = 0.018 * np.arctan2(x[on], z[on])
        uv[on, 1] = y[on]
        on = surfaces == PROBE
        uv[on] = 3.0 * np.stack([x[on] + z[on], y[on]], axis=-1)
        return np.asarray(uv)

    def distance(self, points: npt.ArrayLike, surface: int = ANY) -> Array:
        """Distance (n,) of points (n, 3) to a surface or the nearest, within 0.02 mm; negative inside."""
        places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        result = np.full(len(places), np.inf)
        for kind, (tree, normals) in enumerate(self._trees):
            if surface in (ANY, kind):
                far, nearest = tree.query(places)
                along = np.einsum("ij,ij->i", places - tree.data[nearest], normals[nearest])
                result = np.minimum(result, np.where(along < -0.5 * far, -far, far))
        if surface in (ANY, CAPSULE):
            away = (places - self._wall_centre) / self._wall_radii
            k = np.linalg.norm(away, axis=1)
            slope = np.linalg.norm(away / self._wall_radii, axis=1)
            result = np.minimum(result, k * (1.0 - k) / np.maximum(slope, 1e-9))
        return result

    def ridge(self, along: npt.ArrayLike) -> Array:
        """Points (n, 3) of the tissue below where the gap is narrowest, at places (n,) along the gap."""
        femur, below = self._trees[0][0], np.concatenate([tree.data for tree, _ in self._trees[1:]])
        result = []
        for place in np.atleast_1d(np.asarray(along, dtype=np.float64)):
            near = below[np.abs(below[:, 0] - place) < 0.5e-3]
            near = near[np.linalg.norm(near, axis=1) < 0.03]
            result.append(near[int(np.argmin(femur.query(near)[0]))])
        return np.array(result)

    def contacts(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Points (2, 3) of the femur's contour and of that below to which a line of sight comes closest.

        The angles (2,) [rad] between the line and the points follow.
        """
        found = [silhouette.touched(origin, direction) for silhouette in self._silhouettes]
        return np.stack([point for point, _ in found]), np.array([angle for _, angle in found])

    def tissue_samples(self, centre: Array, reach: float) -> TissueSamples:
        """Points on all surfaces within ``reach`` [m] of a centre (3,)."""
        parts = []
        for side, part in zip((UPPER_SIDE, LOWER_SIDE, LOWER_SIDE), self._parts, strict=True):
            corners = part.corners
            near = np.linalg.norm(corners - centre, axis=2).min(axis=1) < reach
            if near.any():
                parts.append((side, sampled(Surface(part.vertices, part.faces[near]), SPACING)[0]))
        parts.append((AROUND, self._wall_points(centre, reach)))
        return joined(parts, centre, reach)

    def nearest_distance(self) -> tuple[float, Array, Array]:
        """Smallest distance near the middle between femur and tissue below, and its points (3,)."""
        return self._nearest

    @cached_property
    def _silhouettes(self) -> tuple[Silhouette, Silhouette]:
        return Silhouette(self._parts[0]), Silhouette(Surface.joined(list(self._parts[1:])))

    @cached_property
    def _trees(self) -> list[tuple[cKDTree, Array]]:
        found = []
        for part in (part for part in self._parts if len(part.faces)):
            near = np.linalg.norm(part.corners, axis=2).min(axis=1) < 0.05
            points, normals = sampled(Surface(part.vertices, part.faces[near]), _NEAR)
            found.append((cKDTree(points), normals))
        return found

    def _wall_lengths(self, origin: Array, directions: Array) -> Array:
        """Lengths (n,) to the wall, from inside it."""
        o, d = (origin - self._wall_centre) / self._wall_radii, directions / self._wall_radii
        a, b, c = (d * d).sum(axis=1), d @ o, float(o @ o) - 1.0
        return np.asarray((-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a)

    def _wall_points(self, centre: Array, reach: float) -> Array:
        step = _WALL_SPACING / self._wall_radii.max()
        u, v = np.meshgrid(np.arange(0.0, np.pi, step), np.arange(-np.pi, np.pi, step), indexing="ij")
        unit = np.stack([np.cos(u), np.sin(u) * np.cos(v), np.sin(u) * np.sin(v)], axis=-1).reshape(-1, 3)
        points = self._wall_centre + self._wall_radii * unit
        return np.asarray(points[((points - centre) ** 2).sum(axis=1) <= reach * reach])


def _smooth(surface: Surface) -> Array:
    """Normals (m, 3, 3) at the corners of triangles: of the vertices, weighted by area."""
    corners = surface.corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(surface.vertices)
    for k in range(3):
        np.add.at(total, surface.faces[:, k], normals)
    total /= np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None]
    return np.asarray(total[surface.faces])
