"""Surface point and light of every pixel of a picture of a knee of meshes."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.anatomy.mesh_knee import MeshKnee
from knee_gap_simulation.knee.ray_casting import NOTHING, SurfaceMap

_ABOVE = 30e-6  # [m]: rays of light begin this far above the surface
_OPEN = (0.8e-3, 3.0e-3)  # lengths [m] over which the way out of the tissue is probed
_SOFT_PX = 7  # blur of shadows


class MeshMapper:
    """Casts the rays of a fixed grid of bearings (h, w, 3), NaN outside the picture, into meshes."""

    def __init__(self, scene: MeshKnee, bearings: Array) -> None:
        self._scene, self._bearings = scene, bearings

    def map(self, T_scene_lens: Array, lamp: Array, probe: Array | None = None) -> SurfaceMap:
        """Surfaces behind all pixels at a lens pose, lit from ``lamp`` (3,) in the scene."""
        shape = self._bearings.shape[:2]
        inside = np.isfinite(self._bearings[..., 0])
        directions = self._bearings[inside] @ T_scene_lens[:3, :3].T
        points, normal, surface, length = self._scene.cast(T_scene_lens[:3, 3], directions, probe)
        lengths, surfaces = np.full(shape, np.nan), np.full(shape, NOTHING, np.uint8)
        normals, reach = np.zeros((*shape, 3)), np.ones((*shape, 2))
        lengths[inside], surfaces[inside], normals[inside] = length, surface, normal
        start = points + _ABOVE * normal
        to_lamp = lamp - start
        far = np.linalg.norm(to_lamp, axis=1)
        lit = self._scene.rays.free(start, to_lamp / far[:, None], 0.97 * far)
        openness = np.mean(
            [self._scene.rays.free(start, normal, np.full(len(start), reached)) for reached in _OPEN], axis=0
        )
        for layer, values in enumerate((lit, 0.3 + 0.7 * openness)):
            plane = np.ones(shape, np.float32)
            plane[inside] = values
            reach[..., layer] = cv2.blur(plane, (_SOFT_PX, _SOFT_PX))
        return SurfaceMap(lengths, surfaces, normals, reach)
