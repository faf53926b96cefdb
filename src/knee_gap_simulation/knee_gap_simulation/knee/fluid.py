"""The fluid between lens and tissue: turbid saline, wisps of blood, drifting shreds."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.textures import band_noise, linear_from_srgb

FloatImage = npt.NDArray[np.float32]

_VEIL_COLOUR = linear_from_srgb((214, 196, 186))[::-1].astype(np.float32)
_BLOOD = linear_from_srgb((196, 92, 72))[::-1].astype(np.float32)
# The box of the scene in which shreds drift: half sizes [m] around its centre.
_BOX = np.array([0.010, 0.007, 0.006])
_BOX_CENTRE = np.array([0.0, 0.0, -0.004])


class Turbidity:
    """The veil of light scattered back by the fluid, and wisps of blood that drift through the image."""

    def __init__(self, veil: float, wisps: float, shape: tuple[int, ...], seed: int) -> None:
        self._veil, self._wisps, self._shape = veil, wisps, shape
        rng = np.random.default_rng([seed, 0x5455])
        self._cloud = band_noise(rng, (2.0, 14.0), slope=1.6, size_px=256)
        y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, side) for side in shape), indexing="ij")
        # The lamp lights the fluid most in the middle of the image.
        self._beam = (1.0 - 0.55 * np.clip(x**2 + y**2, 0.0, 1.0)).astype(np.float32)
        self._drift = rng.uniform(-14.0, 14.0, 2)

    def over(self, image: FloatImage, lengths: Array, time: float, lens: Array) -> FloatImage:
        """The image (h, w, 3) seen through lengths (h, w) of fluid, at a time [s] from a lens (3,)."""
        if self._veil == 0.0 and self._wisps == 0.0:
            return image
        depth = np.nan_to_num(lengths, nan=0.03).astype(np.float32)
        thickness = 1.0 - np.exp(-depth / 0.012)
        result = image * (1.0 - 0.5 * self._veil * thickness[..., None])
        result += self._veil * (thickness * self._beam)[..., None] * _VEIL_COLOUR
        if self._wisps > 0.0:
            cover = self._wisp_cover(time, lens)[..., None]
            result = result * (1.0 - 0.75 * cover) + 0.16 * cover * _BLOOD
        return np.asarray(result, dtype=np.float32)

    def _wisp_cover(self, time: float, lens: Array) -> FloatImage:
        # Wisps are a few millimetres in front of the lens: they cross the image as it moves.
        shift = self._drift * time - 9e3 * lens[:2]
        size = 120
        y, x = np.mgrid[0:size, 0:size].astype(np.float32)
        u, v = np.mod(x * 0.8 + shift[0], 256.0), np.mod(y * 0.8 + shift[1], 256.0)
        cloud = cv2.remap(self._cloud, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        cover = self._wisps * np.clip(0.7 * cloud + 0.1, 0.0, 1.0)
        return np.asarray(cv2.resize(cover, self._shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)


@dataclass(frozen=True)
class _Shred:
    place: Array
    velocity: Array
    sway: Array
    length: float
    width: float
    bend: float
    turn: float
    spin: float
    opacity: float
    colour: Array


class Debris:
    """Shreds of cartilage and synovium that drift with the fluid; the same seed gives the same shreds."""

    def __init__(self, count: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 0x4445])
        flow = rng.uniform(-1.2e-3, 1.2e-3, 3)
        tints = linear_from_srgb(np.array([(236, 226, 206), (226, 206, 180), (206, 150, 130)]))
        self._shreds = [
            _Shred(
                place=rng.uniform(-1.0, 1.0, 3) * _BOX,
                velocity=flow + rng.normal(0.0, 0.8e-3, 3),
                sway=rng.uniform(0.0, 2.0 * np.pi, 3),
                length=float(rng.lognormal(np.log(0.35e-3), 0.55)),
                width=float(rng.lognormal(np.log(0.07e-3), 0.4)),
                bend=float(rng.normal(0.0, 0.8)),
                turn=float(rng.uniform(0.0, np.pi)),
                spin=float(rng.normal(0.0, 0.8)),
                opacity=float(rng.uniform(0.35, 0.95)),
                colour=tints[rng.integers(len(tints)), ::-1] * rng.uniform(0.6, 1.0),
            )
            for _ in range(count)
        ]

    def over(
        self,
        image: FloatImage,
        T_scene_lens: Array,
        lengths: Array,
        time: float,
        lens: Lens,
        corner_px: tuple[int, int],
        softness_px: float,
    ) -> tuple[FloatImage, FloatImage]:
        """The image (h, w, 3) with shreds in front, and the fraction (h, w) of each pixel that they cover.

        ``lengths`` (h, w) of the rays determine which shreds are behind tissue; ``corner_px`` (row, column)
        is the position of the image in the full image.
        """
        result, cover = image.copy(), np.zeros(image.shape[:2], np.float32)
        for shred in self._shreds:
            place = shred.place + shred.velocity * time + 0.3e-3 * np.sin(shred.sway + 2.0 * time)
            place = np.mod(place + _BOX, 2.0 * _BOX) - _BOX + _BOX_CENTRE
            in_lens = T_scene_lens[:3, :3].T @ (place - T_scene_lens[:3, 3])
            far = float(np.linalg.norm(in_lens))
            centre = lens.pixels(in_lens)
            if far < 1.5e-3 or not np.isfinite(centre).all():
                continue
            scale = lens.focal_px / far
            # The lens is focused beyond the shreds: near ones are large, blurred and faint.
            soft = softness_px * (1.0 + 4.0 * abs(0.010 / far - 1.0))
            light = min(3.0, (0.010 / far) ** 2) * float(in_lens[2] / far) ** 2
            width = shred.width * scale
            opacity = shred.opacity * min(1.0, width / (0.5 * width + 0.5 * soft))
            _paint(
                result,
                cover,
                lengths,
                float(centre[0]) - corner_px[1],
                float(centre[1]) - corner_px[0],
                shred.length * scale,
                width,
                soft,
                shred.bend,
                shred.turn + shred.spin * time,
                opacity,
                far,
                0.75 * light * shred.colour,
            )
        return result, cover


@compiled
def _paint(
    image: FloatImage,
    cover: FloatImage,
    lengths: Array,
    x_px: float,
    y_px: float,
    length_px: float,
    width_px: float,
    soft_px: float,
    bend: float,
    turn: float,
    opacity: float,
    far: float,
    colour: Array,
) -> None:
    """Paint one bent strand with soft borders."""
    reach = int(0.6 * length_px + width_px + 2.0 * soft_px) + 2
    cos, sin = np.cos(turn), np.sin(turn)
    for row in range(max(0, int(y_px) - reach), min(image.shape[0], int(y_px) + reach + 1)):
        for column in range(max(0, int(x_px) - reach), min(image.shape[1], int(x_px) + reach + 1)):
            if lengths[row, column] < far:
                continue
            dx, dy = column - x_px, row - y_px
            along, across = cos * dx + sin * dy, -sin * dx + cos * dy
            # The spine is a parabola, thinner towards its ends.
            share = along / (0.5 * length_px)
            across -= bend * 0.25 * length_px * (share * share - 0.3)
            over = max(0.0, abs(share) - 1.0) * 0.5 * length_px
            half = 0.5 * width_px * max(0.25, 1.0 - 0.6 * share * share)
            half *= 1.0 + 0.35 * np.sin(7.0 * share + 3.0 * bend)
            distance = np.sqrt(across * across + over * over) - half
            edge = min(1.0, max(0.0, 0.5 - 0.5 * distance / soft_px))
            alpha = opacity * edge * edge * (3.0 - 2.0 * edge)
            if alpha <= 0.0:
                continue
            for channel in range(3):
                image[row, column, channel] += alpha * (colour[channel] - image[row, column, channel])
            cover[row, column] += alpha * (1.0 - cover[row, column])
