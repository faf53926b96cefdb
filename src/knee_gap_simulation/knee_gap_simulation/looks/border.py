"""The border of the field in a look: notch inwards or outwards, fringe, surround, writing."""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.looks.look import Border, Look, shared_rng
from knee_gap_simulation.scope.imaging import ByteImage, FloatImage
from knee_gap_simulation.scope.lens import Lens

_WORDS = ("Condyle", "Meniscus", "tear", "femur", "tibia", "a", "B")
_INKS = ((255, 255, 255), (40, 220, 240), (80, 230, 90), (20, 140, 250), (20, 20, 20))


class FieldBorder(NamedTuple):
    """Transmission of the border, of the whole image.

    stop (height, width): light that passes, the outward notch included; without it, field (height, width).
    fringe (height, width, 3): light of each channel relative to the stop.
    """

    stop: FloatImage
    field: FloatImage
    fringe: FloatImage


def field_border(lens: Lens, look: Look) -> FieldBorder:
    """The border of a lens in a look."""
    border = look.border
    offset = (lens.pixel_grid() - (lens.centre_x_px, lens.centre_y_px)).astype(np.float32)
    radius = np.hypot(offset[..., 0], offset[..., 1])
    field = lens.field_stop()
    visible = field > 0.0
    rows = np.arange(lens.height_px)[:, None]
    uncut = (rows >= lens.cut_top_px) & (rows < lens.height_px - lens.cut_bottom_px)
    stop = field
    if border.notch_height != 0.0:
        away = np.abs(
            (np.arctan2(offset[..., 1], offset[..., 0]) - border.notch_angle + np.pi) % (2 * np.pi) - np.pi
        )
        height = abs(border.notch_height) * (1.0 - away / border.notch_half_width)
        past = (radius / np.float32(lens.radius_px) - 1.0) * np.float32(lens.radius_px)
        reach = height * lens.radius_px
        if border.notch_height > 0.0:
            field = field * np.where(height > 0.0, np.clip(0.5 - reach - past, 0.0, 1.0), 1.0)
            stop = field = field.astype(np.float32)
        else:
            notch = border.notch_light * np.clip(reach - past + 0.5, 0.0, 1.0) * (height > 0.0)
            stop = np.maximum(field, np.where(uncut, notch, 0.0)).astype(np.float32)
    fringe = np.ones((*stop.shape, 3), np.float32)
    inner = np.where(visible, radius, 0.0)
    for channel, shift in enumerate(look.head.fringe_px):
        if shift != 0.0:
            # A coloured rim: this channel's field is a little smaller.
            fringe[..., channel] = np.clip((lens.radius_px + shift - inner) / 1.5, 0.0, 1.0)
    return FieldBorder(stop, field.astype(np.float32), fringe)


class Surround:
    """What the video processor or a printer shows around the field, and what is written on the picture."""

    def __init__(self, lens: Lens, look: Look, stop: FloatImage) -> None:
        border, rng = look.border, shared_rng(look.seed, 2)
        shape = (lens.height_px, lens.width_px)
        self._outside = (1.0 - np.clip(stop, 0.0, 1.0))[..., None]
        self._surround = np.asarray(border.surround[::-1], np.float32)
        self._grain, self._seed = border.grain, look.seed
        ink, cover = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
        _write(ink, cover, border, lens, rng)
        inside = stop > 0.0
        if border.margin:
            # A printed page: a white margin that does not reach the field.
            columns = np.flatnonzero(inside.any(axis=0))
            left = int(0.8 * columns[0])
            ink[:, :left], cover[:, :left] = 238, 255
        self._ink, self._cover = ink.astype(np.float32), (cover / np.float32(255.0))[..., None]
        self.written = np.where(inside, self._cover[..., 0], 0.0).astype(np.float32)

    def around(self, image: ByteImage, frame: int) -> ByteImage:
        """The image (height, width, 3) with its surround and what is written on it."""
        result = image.astype(np.float32)
        if self._surround.any() or self._grain > 0.5:
            rng = np.random.default_rng([self._seed, 0x5355, frame])
            noise = self._grain * rng.standard_normal((*image.shape[:2], 1), dtype=np.float32)
            result += self._outside * np.maximum(self._surround + noise, 0.0)
        result += self._cover * (self._ink - result)
        return np.clip(np.round(result), 0, 255).astype(np.uint8)


def _write(
    ink: ByteImage, cover: npt.NDArray[np.uint8], border: Border, lens: Lens, rng: np.random.Generator
) -> None:
    height, width = cover.shape
    scale = height / 720.0
    font = cv2.FONT_HERSHEY_SIMPLEX if rng.random() < 0.6 else cv2.FONT_HERSHEY_DUPLEX

    def put(text: str, place: Array, size: float, colour: tuple[int, int, int]) -> None:
        at = (int(place[0]), int(place[1]))
        thickness = max(1, round(1.6 * size))
        for canvas, value in ((ink, colour), (cover, (255, 255, 255))):
            cv2.putText(canvas, text, at, font, size, value, thickness, cv2.LINE_AA)

    colour = _INKS[rng.integers(len(_INKS) - 1)]
    size = scale * float(rng.uniform(0.5, 0.95))
    corner = np.array([0.015 * width, 0.05 * height if rng.random() < 0.5 else 0.80 * height])
    if rng.random() < 0.4:
        corner[0] = 0.80 * width
    for index, line in enumerate(border.lines):
        put(line, corner + np.array([0.0, index * 34.0 * size]), size, colour)
    centre = np.array([lens.centre_x_px, lens.centre_y_px])
    reach = 0.7 * min(lens.radius_px, 0.5 * height)
    for _ in range(border.labels):
        place = centre + rng.uniform(-1.0, 0.8, 2) * reach * 0.7
        colour = _INKS[rng.integers(len(_INKS))]
        if rng.random() < 0.5:
            put(str(rng.choice(_WORDS)), place, scale * float(rng.uniform(0.7, 1.3)), colour)
            continue
        tip = place + rng.uniform(-0.35, 0.35, 2) * reach
        start, end = ((int(p[0]), int(p[1])) for p in (place, tip))
        for canvas, value in ((ink, colour), (cover, (255, 255, 255))):
            cv2.arrowedLine(canvas, start, end, value, max(2, round(9 * scale)), cv2.LINE_AA, 0, 0.35)
