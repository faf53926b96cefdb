"""Interface of a knee's scene for the camera and the ground truth, of formulas or of meshes."""

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.ray_casting import SurfaceMap
from knee_gap_simulation.surfaces.tissue_samples import TissueSamples


class KneeShape(Protocol):
    """The shape of a knee, in the frame of its scene; the methods are explained in `KneeScene`."""

    def __hash__(self) -> int: ...

    def as_dict(self) -> dict[str, Any]:
        """The knee as plain values for JSON."""
        ...

    def cast(
        self,
        origin: Array,
        directions: Array,
        probe: Array | None = None,
        *,
        starts: Array | None = None,
        exact: bool = True,
    ) -> tuple[Array, Array, npt.NDArray[np.uint8], Array]:
        """First surface along rays: points, normals, surfaces, lengths."""
        ...

    def surface_points(self, T_scene_lens: Array, bearings: Array, probe: Array | None = None) -> Array:
        """Points (n, 3) of the scene behind bearings (n, 3) of a lens."""
        ...

    def looks_into_gap(
        self, T_scene_lens: Array, bearings: Array, probe: Array | None = None
    ) -> npt.NDArray[np.bool_]:
        """Whether bearings (n, 3) of a lens look into the gap."""
        ...

    def is_gap(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Whether points (n, 3) on surfaces (n,) were seen through the gap."""
        ...

    def uv(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> Array:
        """Coordinates (n, 2) [m] on the surface of points (n, 3)."""
        ...

    def distance(self, points: npt.ArrayLike, surface: int = -1) -> Array:
        """Distance (n,) of points (n, 3) to a surface, or the nearest."""
        ...

    def ridge(self, along: npt.ArrayLike) -> Array:
        """Points (n, 3) of the tissue below the gap, at places (n,) along it."""
        ...

    def contacts(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Points (2, 3) of both sides to which a line of sight comes closest, and the angles (2,)."""
        ...

    def tissue_samples(self, centre: Array, reach: float) -> TissueSamples:
        """Points on all surfaces within a reach [m] of a centre (3,)."""
        ...

    def nearest_distance(self) -> tuple[float, Array, Array]:
        """Smallest distance between the sides near the middle, and its points."""
        ...


class Mapper(Protocol):
    """Finds the surface behind every pixel of a fixed grid of bearings."""

    def map(self, T_scene_lens: Array, lamp: Array, probe: Array | None = None) -> SurfaceMap:
        """Surfaces behind all pixels at a lens pose, lit from ``lamp`` (3,)."""
        ...
