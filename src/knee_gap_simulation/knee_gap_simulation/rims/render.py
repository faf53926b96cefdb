"""Renderer of a scene: rays through every pixel of the field of view, light, and the camera head."""

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.scope.imaging import AutoExposure, ByteImage, Sensor, develop
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.notch import Notch
from knee_gap_simulation.surfaces.shading import Light, shade
from knee_gap_simulation.surfaces.textures import FloatImage


class Scene(Protocol):
    """Interface of a scene. All values are in the scene's own frame, lengths in metres."""

    def textures(self) -> FloatImage:
        """Textures (k, size, size, channels) of its surfaces."""
        ...

    def cast(self, origin: Array, directions: Array) -> tuple[Array, Array, Array, npt.NDArray[np.uint8]]:
        """Points (n, 3), normals (n, 3), uv (n, 2) and surfaces (n,) that rays (n, 3) from (3,) hit."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """The scene as plain values for JSON."""
        ...


class ScopeCamera:
    """Renders frames of a scene in order, with automatic exposure from frame to frame."""

    def __init__(
        self,
        scene: Scene,
        lens: Lens | None = None,
        *,
        light: Light | None = None,
        sensor: Sensor | None = None,
        seed: int = 0,
    ) -> None:
        self.scene, self.lens = scene, lens or Lens()
        self.light, self.sensor = light or Light(), sensor or Sensor()
        self._seed, self._frame = seed, 0
        self._textures = scene.textures()
        stop = self.lens.field_stop()
        rows, columns = np.nonzero(stop)
        # Only the box around the field of view is rendered; the rest stays black.
        self._box = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
        self._stop = np.ascontiguousarray(stop[self._box])
        self._inside = self._stop > 0.0
        self._notch = Notch(self.lens, self._box)
        # Rays of the soft border lie just beyond the field of view: use the bearing of the rim there.
        pixels = self.lens.pixel_grid()[self._box][self._inside]
        centre = np.array([self.lens.centre_x_px, self.lens.centre_y_px])
        offset = pixels - centre
        radius = np.hypot(offset[:, 0], offset[:, 1])
        shrink = np.minimum(1.0, (self.lens.radius_px - 1e-6) / np.maximum(radius, 1e-9))
        self._bearings = self.lens.bearings(centre + offset * shrink[:, None])
        self._exposure = AutoExposure(self.sensor)

    def radiance(self, T_scene_lens: Array) -> FloatImage:
        """Linear light (h, w, 3), blue green red, before the field stop, in the box around the picture."""
        directions = np.ascontiguousarray(self._bearings @ T_scene_lens[:3, :3].T)
        hits = self.scene.cast(T_scene_lens[:3, 3].copy(), directions)
        image = np.zeros((*self._stop.shape, 3), np.float32)
        image[self._inside] = shade(*hits, self._textures, T_scene_lens, self.light)
        return image

    def frame(
        self, T_scene_lens: Array, step_s: float = 1.0 / 60.0, notch_angle: float | None = None
    ) -> ByteImage:
        """The next picture (height, width, 3) bgr8, ``step_s`` after the last one.

        With ``notch_angle`` [rad] the field stop has a notch there, from the picture's x towards its y.
        """
        light = self.radiance(T_scene_lens)
        stop = self._stop
        if notch_angle is not None:
            stop = np.asarray(stop * self._notch.light(notch_angle))
        gain = self._exposure.gain(light, self._stop, step_s)
        rng = np.random.default_rng([self._seed, 0x4E4F, self._frame])
        self._frame += 1
        picture = np.zeros((self.lens.height_px, self.lens.width_px, 3), np.uint8)
        picture[self._box] = develop(light, stop, gain, self.sensor, rng)
        return picture
