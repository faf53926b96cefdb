"""Renderer of images of the knee at a given difficulty."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.camera_head import CameraHead, focus_blur, motion_blur
from knee_gap_simulation.knee.difficulty import Conditions
from knee_gap_simulation.knee.fluid import Debris, Turbidity
from knee_gap_simulation.knee.ray_casting import NOTHING, SurfaceMapper
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.knee.shape import KneeShape, Mapper
from knee_gap_simulation.knee.tissues import knee_textures
from knee_gap_simulation.scope.imaging import ByteImage, FloatImage
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.distance_field import PROBE
from knee_gap_simulation.surfaces.shading import Light, shade


class KneeLight(NamedTuple):
    """Light on the sensor, in the box around the field of view, with its ground truth.

    light (h, w, 3): linear, blue green red. gap_mask (height, width): the pixels of the whole image that
    look into the gap. debris_cover (height, width): fraction of each pixel that debris covers.
    instrument_mask (height, width): the pixels that show the probe.
    """

    light: FloatImage
    gap_mask: npt.NDArray[np.bool_]
    debris_cover: FloatImage
    instrument_mask: npt.NDArray[np.bool_]


class Dressing(NamedTuple):
    """What a look changes in the camera, made once for a recording.

    ``textures`` (5, size, size, channels) and ``light``. ``stop`` (height, width) is the light that passes
    the border of the whole image, ``field`` without what shows beyond the lens's field. ``over`` draws small
    things into light and cover, ``finish`` the surround into the image, ``written`` (height, width) is what
    it covers. ``fibres`` are added to the debris. ``head`` makes the camera head of the box of a stop.
    """

    textures: FloatImage
    light: Light
    stop: FloatImage
    field: FloatImage
    over: Callable[[FloatImage, FloatImage, Array, Array, float, tuple[int, int], float], None]
    finish: Callable[[ByteImage, int], ByteImage]
    written: FloatImage
    fibres: int
    head: Callable[[tuple[slice, slice], FloatImage, npt.NDArray[np.float32]], CameraHead]


class KneeCamera:
    """Renders images of a knee in order of time."""

    def __init__(
        self,
        scene: KneeShape,
        lens: Lens,
        conditions: Conditions,
        seed: int,
        dressing: Dressing | None = None,
        mapper: Callable[[Array], Mapper] | None = None,
    ) -> None:
        """``mapper`` makes what finds the surfaces behind bearings, for a scene that is no `KneeScene`."""
        self._scene, self._lens, self._conditions = scene, lens, conditions
        self._dressing = dressing
        stop = lens.field_stop() if dressing is None else dressing.stop
        rows, columns = np.nonzero(stop)
        self._box = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
        self._stop = np.ascontiguousarray(stop[self._box])
        self._field = self._stop if dressing is None else dressing.field[self._box]
        offset = lens.pixel_grid()[self._box] - (lens.centre_x_px, lens.centre_y_px)
        radius = np.hypot(offset[..., 0], offset[..., 1]) / lens.radius_px
        # Pixels on the soft border of the stop show the rim of the field of view.
        shrink = np.where(self._stop > 0.0, np.minimum(1.0, (1.0 - 1e-9) / np.maximum(radius, 1e-9)), 1.0)
        centre = np.array([lens.centre_x_px, lens.centre_y_px])
        self._bearings = lens.bearings(centre + offset * shrink[..., None])
        self._inside = np.isfinite(self._bearings[..., 0])
        self._mapper: Mapper
        if mapper is not None:
            self._mapper = mapper(self._bearings)
        else:
            assert isinstance(scene, KneeScene)
            self._mapper = SurfaceMapper(scene, self._bearings)
        self._textures = knee_textures(seed, conditions.contrast) if dressing is None else dressing.textures
        self._light = (
            dressing.light
            if dressing is not None
            else Light(
                spread=conditions.beam,
                absorption=conditions.absorption,
                glare=conditions.glare,
                shininess=70.0,
                ambient=0.012,
                glint=4.0,
                sheen=0.03,
                facing_exponent=0.6,
            )
        )
        self._turbidity = Turbidity(conditions.veil, conditions.wisps, self._stop.shape, seed)
        self._debris = Debris(conditions.debris + (0 if dressing is None else dressing.fibres), seed)
        radius = radius.astype(np.float32)
        self._head = (
            CameraHead(conditions, self._stop, radius, seed)
            if dressing is None
            else dressing.head(self._box, self._stop, radius)
        )

    def light(self, T_scene_lens: Array, time: float, shift_px: Array, probe: Array | None) -> KneeLight:
        """Light on the sensor for a lens pose at a time [s]; may be called from several threads.

        ``shift_px`` (2,) is the shift of the centre of the image while the shutter is open.
        """
        lamp = T_scene_lens[:3, :3] @ np.asarray(self._light.position) + T_scene_lens[:3, 3]
        seen = self._mapper.map(T_scene_lens, lamp, probe)
        inside = self._inside
        directions = self._bearings[inside] @ T_scene_lens[:3, :3].T
        points = T_scene_lens[:3, 3] + seen.lengths[inside, None] * directions
        surfaces = seen.surfaces[inside]
        light: FloatImage = np.zeros((*self._stop.shape, 3), np.float32)
        light[inside] = shade(
            points,
            seen.normals[inside],
            self._scene.uv(points, surfaces),
            surfaces,
            self._textures,
            T_scene_lens,
            self._light,
            seen.reach[inside],
        )
        light = self._turbidity.over(light, seen.lengths, time, T_scene_lens[:3, 3])
        light = focus_blur(light, seen.lengths, self._conditions.defocus_px)
        lengths = np.where(seen.surfaces == NOTHING, 1.0, seen.lengths)
        corner = self._box[0].start, self._box[1].start
        softness_px = self._conditions.softness_px
        light, cover = self._debris.over(light, T_scene_lens, lengths, time, self._lens, corner, softness_px)
        if self._dressing is not None:
            self._dressing.over(light, cover, T_scene_lens, lengths, time, corner, softness_px)
        light = motion_blur(light, shift_px)
        whole = (self._lens.height_px, self._lens.width_px)
        mask, debris_cover = np.zeros(whole, bool), np.zeros(whole, np.float32)
        instrument = np.zeros(whole, bool)
        gap = np.zeros(self._stop.shape, bool)
        gap[inside] = self._scene.is_gap(points, surfaces)
        mask[self._box], debris_cover[self._box] = gap & (self._field >= 1.0), cover
        instrument[self._box] = (seen.surfaces == PROBE) & (self._field >= 1.0)
        if self._dressing is not None:
            debris_cover = np.maximum(debris_cover, self._dressing.written)
        return KneeLight(light, mask, debris_cover, instrument)

    def develop(self, light: KneeLight, frame: int, step_s: float) -> ByteImage:
        """Image (height, width, 3) bgr8 of light. Call in order of time, since the exposure is controlled.

        ``frame`` seeds its noise, ``step_s`` is the time since the last image.
        """
        image = np.zeros((self._lens.height_px, self._lens.width_px, 3), np.uint8)
        image[self._box] = self._head.develop(light.light, frame, step_s)
        return image if self._dressing is None else self._dressing.finish(image, frame)
