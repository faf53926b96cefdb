"""The truth of a simulated recording: which surface point lies behind any pixel."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.lens import Lens
from knee_gap_simulation.rigid import FloatArray, inverse
from knee_gap_simulation.rims import KIND as RIMS
from knee_gap_simulation.rims import RimScene
from knee_gap_simulation.scope import Scope

METADATA_KEY = "knee_gap_simulation"


@dataclass(frozen=True)
class SceneTruth:
    """A scene, where it lies in the world, and the scope that looked at it."""

    scene: RimScene
    T_world_scene: FloatArray
    lens: Lens
    scope: Scope

    def surface_points(self, T_world_lens: npt.ArrayLike, pixels: npt.ArrayLike) -> FloatArray:
        """Points (n, 3) in the world [m] behind pixels (n, 2) [px] of an image with a true lens pose (4, 4).

        NaN where the ray meets nothing and outside the field of view.
        """
        bearings = self.lens.bearings(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        T_scene_lens = inverse(self.T_world_scene) @ np.asarray(T_world_lens, dtype=np.float64)
        points = self.scene.surface_points(T_scene_lens, bearings)
        return np.asarray(points @ self.T_world_scene[:3, :3].T + self.T_world_scene[:3, 3])

    def gap_mask(self, T_world_lens: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Pixels (height, width) of an image that look into the gap."""
        T_scene_lens = inverse(self.T_world_scene) @ np.asarray(T_world_lens, dtype=np.float64)
        bearings = self.lens.bearings(self.lens.pixel_grid())
        seen = np.isfinite(bearings[..., 0])
        mask = np.zeros(seen.shape, bool)
        directions = np.ascontiguousarray(bearings[seen] @ T_scene_lens[:3, :3].T)
        mask[seen] = self.scene.is_gap(self.scene.cast(T_scene_lens[:3, 3].copy(), directions)[3])
        return mask

    def as_metadata(self, **more: Any) -> dict[str, str]:
        """Metadata of a bag from which `scene_from_metadata` makes this truth again."""
        values = {
            "format": 1,
            "scene": self.scene.as_dict(),
            "T_world_scene": self.T_world_scene.tolist(),
            "lens": asdict(self.lens),
            "scope": asdict(self.scope),
            "T_body_lens": self.scope.body_to_lens().tolist(),
            **more,
        }
        return {METADATA_KEY: json.dumps(values, sort_keys=True)}


def scene_from_metadata(metadata: Mapping[str, str]) -> SceneTruth:
    """The truth that a bag's metadata tell. Raises SimulationError where there is none."""
    try:
        values = json.loads(metadata[METADATA_KEY])
        kind = values["scene"]["kind"]
    except (KeyError, TypeError, json.JSONDecodeError):
        raise SimulationError(
            f"the bag's metadata have no scene under '{METADATA_KEY}': it is not simulated"
        ) from None
    if values.get("format") != 1 or kind != RIMS:
        raise SimulationError(
            f"the scene '{kind}' of format {values.get('format')} is unknown; known: '{RIMS}', format 1"
        )
    return SceneTruth(
        scene=RimScene.from_dict(values["scene"]),
        T_world_scene=np.array(values["T_world_scene"]),
        lens=Lens(**values["lens"]),
        scope=Scope.from_dict(values["scope"]),
    )
