"""The truth of a simulated recording: which surface point lies behind any pixel."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_node.user_files import json_value
from knee_gap_simulation.clocks import seconds
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee import KIND as KNEE
from knee_gap_simulation.knee import KneeScene
from knee_gap_simulation.lens import Lens
from knee_gap_simulation.probe import Probe
from knee_gap_simulation.rigid import FloatArray, inverse
from knee_gap_simulation.rims import KIND as RIMS
from knee_gap_simulation.rims import RimScene
from knee_gap_simulation.scope import Scope

METADATA_KEY = "knee_gap_simulation"


@dataclass(frozen=True)
class SceneTruth:
    """A scene, where it lies in the world, the scope that looked at it, and the probe that came and went."""

    scene: RimScene | KneeScene
    T_world_scene: FloatArray
    lens: Lens
    scope: Scope
    probe: Probe | None = None

    def surface_points(
        self, T_world_lens: npt.ArrayLike, pixels: npt.ArrayLike, stamp_ns: int | None = None
    ) -> FloatArray:
        """Points (n, 3) in the world [m] behind pixels (n, 2) [px] of an image with a true lens pose (4, 4).

        NaN where the ray meets nothing and outside the field of view. With the stamp of the image a pixel
        that shows the probe gives the probe's point, without it the tissue behind.
        """
        bearings = self.lens.bearings(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        T_scene_lens = self._lens_in_scene(T_world_lens)
        if isinstance(self.scene, KneeScene):
            points = self.scene.surface_points(T_scene_lens, bearings, self._rods(stamp_ns))
        else:
            points = self.scene.surface_points(T_scene_lens, bearings)
        return np.asarray(points @ self.T_world_scene[:3, :3].T + self.T_world_scene[:3, 3])

    def gap_mask(self, T_world_lens: npt.ArrayLike, stamp_ns: int | None = None) -> npt.NDArray[np.bool_]:
        """Pixels (height, width) of an image that look into the gap, with its stamp past the probe."""
        bearings = self.lens.bearings(self.lens.pixel_grid())
        seen = np.isfinite(bearings[..., 0])
        mask = np.zeros(seen.shape, bool)
        T_scene_lens = self._lens_in_scene(T_world_lens)
        if isinstance(self.scene, KneeScene):
            mask[seen] = self.scene.looks_into_gap(T_scene_lens, bearings[seen], self._rods(stamp_ns))
        else:
            mask[seen] = self.scene.looks_into_gap(T_scene_lens, bearings[seen])
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
        if self.probe is not None:
            values["probe"] = self.probe.as_dict()
        return {METADATA_KEY: json.dumps(values, sort_keys=True)}

    def _lens_in_scene(self, T_world_lens: npt.ArrayLike) -> FloatArray:
        return inverse(self.T_world_scene) @ np.asarray(T_world_lens, dtype=np.float64)

    def _rods(self, stamp_ns: int | None) -> FloatArray | None:
        return None if stamp_ns is None or self.probe is None else self.probe.joints(seconds(stamp_ns))


def scene_from_metadata(metadata: Mapping[str, str]) -> SceneTruth:
    """The truth that a bag's metadata tell. Raises SimulationError where there is none."""
    try:
        values = json_value(metadata[METADATA_KEY])
        kind = values["scene"]["kind"]
    except (LookupError, TypeError, ValueError):
        raise SimulationError(
            f"the bag's metadata have no scene under '{METADATA_KEY}': it is not simulated"
        ) from None
    if values.get("format") != 1 or kind not in (RIMS, KNEE):
        raise SimulationError(
            f"the scene '{kind}' of format {values.get('format')} is unknown; known: {RIMS}, {KNEE}, format 1"
        )
    try:
        scene: RimScene | KneeScene
        scene = (RimScene if kind == RIMS else KneeScene).from_dict(values["scene"])
        return SceneTruth(
            scene=scene,
            T_world_scene=np.array(values["T_world_scene"], dtype=np.float64).reshape(4, 4),
            lens=Lens(**values["lens"]),
            scope=Scope.from_dict(values["scope"]),
            probe=Probe.from_dict(values["probe"]) if "probe" in values else None,
        )
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SimulationError(f"the scene in the bag's metadata is damaged: {reason}") from None
