"""A joint drawn by formula, two textured planes and a gap, and where its pixels go as the lens moves."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_core.values.arrays import Array, Image
from knee_gap_perception.camera.models import FisheyeCamera

TEXEL = 2.0e-5  # [m]
HALF_GAP = 2.0e-3  # [m]
SLOPE = 0.35  # each tissue falls away from the gap's plane
DISTANCE = 0.010  # [m] of the rims from the lens' first place


@dataclass(frozen=True)
class Joint:
    """Tissue z = DISTANCE + SLOPE (|y| - HALF_GAP) for |y| > HALF_GAP, in the frame of the first lens."""

    camera: FisheyeCamera
    texture: npt.NDArray[np.float32]

    @cached_property
    def rays(self) -> tuple[npt.NDArray[np.bool_], Array]:
        """Pixels (h, w) inside the field of view, and the bearings (n, 3) there."""
        camera = self.camera
        u, v = np.meshgrid(np.arange(camera.width_px, dtype=float), np.arange(camera.height_px, dtype=float))
        inside = np.hypot(u - camera.cx, v - camera.cy) < 355
        return inside, camera.bearings(np.stack([u[inside], v[inside]], axis=-1))

    def cast(self, T_first_lens: Array, bearings: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Points (..., 3) that bearings (..., 3) meet, and where they look into the gap."""
        d = bearings @ T_first_lens[:3, :3].T
        o = T_first_lens[:3, 3]
        points = np.full(d.shape, np.nan)
        for side in (-1.0, 1.0):
            # z - DISTANCE = SLOPE (side y - HALF_GAP)
            along = (DISTANCE - SLOPE * HALF_GAP + SLOPE * side * o[1] - o[2]) / (
                d[..., 2] - SLOPE * side * d[..., 1]
            )
            hit = o + along[..., None] * d
            tissue = (along > 0) & (side * hit[..., 1] > HALF_GAP)
            points = np.where(tissue[..., None], hit, points)
        return points, np.isnan(points[..., 0]) & np.isfinite(bearings[..., 0])

    def picture(self, T_first_lens: Array, seed: int, noise: float = 2.0) -> Image:
        """Image (h, w, 3) with the light at the lens, a circular field of view and noise [grey levels]."""
        inside, bearings = self.rays
        points, gap = self.cast(T_first_lens, bearings)
        place = np.nan_to_num(points) / TEXEL
        tile = self.texture.shape[0]
        # The two tissues carry different places of the texture.
        columns, rows = np.zeros((2, *inside.shape), np.float32)
        columns[inside], rows[inside] = place[..., 0] % tile, (place[..., 1] + 311.0) % tile
        albedo = cv2.remap(self.texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[inside]
        distance = np.linalg.norm(np.nan_to_num(points) - T_first_lens[:3, 3], axis=-1)
        lit = 170.0 * albedo * (0.011 / np.maximum(distance, 0.004)) ** 1.2
        grey = np.zeros(inside.shape, np.float32)
        grey[inside] = np.where(gap, 9.0, lit)
        grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + noise * np.random.default_rng(seed).standard_normal(
            grey.shape, np.float32
        )
        channels = [np.clip(share * grey, 0, 255).astype(np.uint8) for share in (0.72, 0.82, 1.0)]
        return np.stack(channels, axis=2)

    def moved_pixels(self, T_from: Array, T_to: Array, pixels: npt.ArrayLike) -> Array:
        """Where the tissue behind pixels (n, 2) of one image is in another."""
        points, _ = self.cast(T_from, self.camera.bearings(pixels))
        return self.camera.pixels((points - T_to[:3, 3]) @ T_to[:3, :3])


def _texture(seed: int) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    total = np.ones((1024, 1024))
    for sigma, amplitude in ((1.5, 0.03), (3.5, 0.05), (9.0, 0.06)):
        noise = cv2.GaussianBlur(np.tile(rng.normal(size=(1024, 1024)), (3, 3)), (0, 0), sigma)[
            1024:2048, 1024:2048
        ]
        total += amplitude * noise / noise.std()
    return total.astype(np.float32)


@pytest.fixture(scope="session")
def joint() -> Joint:
    """The joint before a 1280x720 camera whose field of view is a disc of 355 px."""
    return Joint(FisheyeCamera(1280, 720, 458.4, 458.4, 640.0, 360.0), _texture(4))
