"""Ground truth of a simulated recording: surface points behind pixels, edges and instrument gaps."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_core.user_files import json_value
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.anatomy.mesh_knee import KIND as MESHES
from knee_gap_simulation.anatomy.mesh_knee import MeshKnee
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.probe import Probe
from knee_gap_simulation.knee.scene import KIND as KNEE
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.knee.shape import KneeShape
from knee_gap_simulation.recordings.section_truth import (
    SectionTruth,
    edges_at_section,
    section_truth,
    true_instrument_gap,
)
from knee_gap_simulation.rims.scene import KIND as RIMS
from knee_gap_simulation.rims.scene import RimScene
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.clocks import seconds
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import IN_SALINE, Media, RefractedLens, calibrated
from knee_gap_simulation.surfaces.instrument_gap import CONE, InstrumentGap

METADATA_KEY = "knee_gap_simulation"

# Fractions of the way between two points of the sides at which the opening is searched.
_ALONG_SECTION = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)


@dataclass(frozen=True)
class SceneTruth:
    """A scene, its pose in the world, the scope that recorded it, and the probe.

    `lens` is the lens in use; `media` are those of its calibration and use.
    """

    scene: RimScene | KneeShape
    T_world_scene: Array
    lens: Lens
    scope: Scope
    probe: Probe | None = None
    media: Media = IN_SALINE

    def surface_points(
        self, T_world_lens: npt.ArrayLike, pixels: npt.ArrayLike, stamp_ns: int | None = None
    ) -> Array:
        """Points (n, 3) in the world [m] behind pixels (n, 2) [px] of an image with a true lens pose (4, 4).

        NaN if the ray hits nothing or the pixel is outside the field of view. With the stamp of the image, a
        pixel that shows the probe gives the probe's point; without it, the tissue behind.
        """
        bearings = self.lens.bearings(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        T_scene_lens = self._lens_in_scene(T_world_lens)
        if isinstance(self.scene, RimScene):
            points = self.scene.surface_points(T_scene_lens, bearings)
        else:
            points = self.scene.surface_points(T_scene_lens, bearings, self._rods(stamp_ns))
        return np.asarray(points @ self.T_world_scene[:3, :3].T + self.T_world_scene[:3, 3])

    def gap_mask(self, T_world_lens: npt.ArrayLike, stamp_ns: int | None = None) -> npt.NDArray[np.bool_]:
        """Pixels (height, width) of an image that look into the gap, with its stamp past the probe."""
        bearings = self.lens.bearings(self.lens.pixel_grid())
        seen = np.isfinite(bearings[..., 0])
        mask = np.zeros(seen.shape, bool)
        T_scene_lens = self._lens_in_scene(T_world_lens)
        if isinstance(self.scene, RimScene):
            mask[seen] = self.scene.looks_into_gap(T_scene_lens, bearings[seen])
        else:
            mask[seen] = self.scene.looks_into_gap(T_scene_lens, bearings[seen], self._rods(stamp_ns))
        return mask

    def instrument_gap(
        self, T_world_lens: npt.ArrayLike, edge_bearings: npt.ArrayLike, *, cone: float = CONE
    ) -> InstrumentGap:
        """The instrument gap of the section between two edges (2, 3), unit vectors in the lens frame.

        The lens pose (4, 4) is the true one; the axis is in the world [m]. ``cone`` is the half angle [rad]
        of the axis directions about the direction of view; 0 allows that direction only. Raises
        SimulationError for edges that are not finite or do not bound a gap.
        """
        found = true_instrument_gap(self.scene, self._lens_in_scene(T_world_lens), edge_bearings, cone=cone)
        return found.moved(self.T_world_scene)

    def reported_gap(
        self, T_world_lens: npt.ArrayLike, edge_bearings: npt.ArrayLike, pixels: npt.ArrayLike
    ) -> float:
        """The instrument gap [m] at the section that an image's edges (2, 3) report.

        If they are NaN, it is the section through the middle between two points of the sides, at pixels
        (2, 2) [px] of the image. NaN if there is no opening between those either, and for edges that do not
        bound a gap.
        """
        bearings = np.asarray(edge_bearings, dtype=np.float64).reshape(2, 3)
        ends = np.asarray(pixels, dtype=np.float64).reshape(2, 2)
        if not np.isfinite(bearings).all() and np.isfinite(ends).all():
            for share in _ALONG_SECTION:
                at = ends[0] + share * (ends[1] - ends[0])
                bearings = self.edges_at_section(T_world_lens, at, ends[1] - ends[0])
                if np.isfinite(bearings).all():
                    break
        if not np.isfinite(bearings).all():
            return float("nan")
        try:
            return self.instrument_gap(T_world_lens, bearings).diameter
        except SimulationError:
            return float("nan")

    def section(self, T_world_lens: npt.ArrayLike, edge_bearings: npt.ArrayLike) -> SectionTruth:
        """Ground truth of the section between two edges (2, 3), seen from a true lens pose."""
        found = section_truth(self.scene, self._lens_in_scene(T_world_lens), edge_bearings)
        return found.moved(self.T_world_scene)

    def edges_at_section(
        self,
        T_world_lens: npt.ArrayLike,
        pixel: npt.ArrayLike,
        across_direction: npt.ArrayLike | None = None,
    ) -> Array:
        """True bearings (2, 3) of the edges on the line across the opening through a pixel (2,) in it [px].

        ``across_direction`` (2,) is in the image; by default, the direction of the narrowest opening. NaN if
        the pixel is not in the gap, or if the line leaves the field of view before it meets an edge.
        """
        return edges_at_section(
            self.scene, self.lens, self._lens_in_scene(T_world_lens), pixel, across_direction
        )

    def as_metadata(self, **more: Any) -> dict[str, str]:
        """Metadata of a bag from which `scene_from_metadata` restores this ground truth."""
        values = {
            "format": 1,
            "scene": self.scene.as_dict(),
            "T_world_scene": self.T_world_scene.tolist(),
            "lens": calibrated(self.lens).as_dict(),
            "scope": asdict(self.scope),
            "T_body_lens": self.scope.body_to_lens().tolist(),
            **more,
        }
        if self.media != IN_SALINE:
            values["media"] = list(self.media)
        if self.probe is not None:
            values["probe"] = self.probe.as_dict()
        return {METADATA_KEY: json.dumps(values, sort_keys=True)}

    def _lens_in_scene(self, T_world_lens: npt.ArrayLike) -> Array:
        return inverse(self.T_world_scene) @ np.asarray(T_world_lens, dtype=np.float64)

    def _rods(self, stamp_ns: int | None) -> Array | None:
        return None if stamp_ns is None or self.probe is None else self.probe.joints(seconds(stamp_ns))


def scene_from_metadata(metadata: Mapping[str, str]) -> SceneTruth:
    """Ground truth from a bag's metadata. Raises SimulationError if there is none."""
    try:
        values = json_value(metadata[METADATA_KEY])
        kind = values["scene"]["kind"]
    except (LookupError, TypeError, ValueError):
        raise SimulationError(
            f"the bag's metadata have no scene under '{METADATA_KEY}': it is not simulated"
        ) from None
    scenes: dict[str, Callable[[Mapping[str, Any]], RimScene | KneeShape]] = {
        RIMS: RimScene.from_dict,
        KNEE: KneeScene.from_dict,
        MESHES: MeshKnee.from_dict,
    }
    if values.get("format") != 1 or kind not in scenes:
        raise SimulationError(
            f"the scene '{kind}' of format {values.get('format')} is unknown; "
            f"known: {', '.join(scenes)}, format 1"
        )
    try:
        media = Media(*values.get("media", IN_SALINE))
        return SceneTruth(
            scene=scenes[kind](values["scene"]),
            T_world_scene=np.array(values["T_world_scene"], dtype=np.float64).reshape(4, 4),
            lens=RefractedLens.of(Lens(**values["lens"]), media.ratio),
            scope=Scope.from_dict(values["scope"]),
            probe=Probe.from_dict(values["probe"]) if "probe" in values else None,
            media=media,
        )
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SimulationError(f"the scene in the bag's metadata is damaged: {reason}") from None
