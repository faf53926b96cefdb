"""Detection of the field of view: the disc of the image that the scope fills."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Mask
from knee_gap_perception.image.outline import (
    LEAST_LIGHT,
    best_outline,
    corners,
    cut_in_the_dark,
    fills,
    largest_part,
    picture_threshold,
    sides_of,
)
from knee_gap_perception.image.outline import brightness as brightness

WORKING_ROWS = 180  # image rows at which the disc is searched

TOO_DARK = "the picture is too dark to find the field of view in"
NO_BORDER = "the field of view is not found: the picture shows no round border and does not fill the frame"


@dataclass(frozen=True)
class FieldOfView:
    """A disc (centre column and row, radius [px]) cut by the box of the picture.

    `box` is first column, first row, last column, last row [px]. If the picture fills the frame, there is no
    disc: the radius is infinite and only the box counts.
    """

    centre: tuple[float, float]
    radius: float
    box: tuple[float, float, float, float]

    @property
    def extent(self) -> float:
        """Radius [px] of the disc, or of the largest disc in the box if there is none."""
        x0, y0, x1, y1 = self.box
        return min(self.radius, (x1 - x0) / 2, (y1 - y0) / 2) if np.isinf(self.radius) else self.radius

    def depth_inside(self, pixels: npt.ArrayLike) -> Array:
        """Distance [px] of pixels (..., 2) from the border of the field (...,); negative outside."""
        pixel = np.asarray(pixels, dtype=np.float64)
        x, y = pixel[..., 0], pixel[..., 1]
        x0, y0, x1, y1 = self.box
        sides = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
        disc = self.radius - np.hypot(x - self.centre[0], y - self.centre[1])
        return np.asarray(np.minimum(sides, disc))

    def mask(self, shape: tuple[int, int], scale: float = 1.0, margin: float = 0.0) -> Mask:
        """Pixels of an image of `shape` rows and columns that lie inside by `margin` [px of the full image].

        `scale` is the size of that image against the full one.
        """
        y = (np.arange(shape[0])[:, None] + 0.5) / scale - 0.5
        x = (np.arange(shape[1])[None, :] + 0.5) / scale - 0.5
        x0, y0, x1, y1 = self.box
        inside = (np.minimum(y - y0, y1 - y) > margin) & (np.minimum(x - x0, x1 - x) > margin)
        # Like depth_inside, but without a square root for each pixel.
        reach = max(self.radius - margin, 0.0)
        disc = (x - self.centre[0]) ** 2 + (y - self.centre[1]) ** 2 < reach**2
        return np.asarray(inside & disc)


def find_field_of_view(image: npt.NDArray[np.uint8]) -> FieldOfView | None:
    """The field of view in an image (h, w, 3); None if none is found, as in the dark.

    A picture that fills the frame, or a box in it, is a field without a disc. One that does neither and shows
    no circle, as when half of it is in shade, is not guessed.
    """
    height, width = image.shape[:2]
    scale = min(1.0, WORKING_ROWS / min(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    resized = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    small = np.asarray(cv2.medianBlur(brightness(resized), 3), dtype=np.uint8)
    threshold = picture_threshold(small)
    if threshold is None:
        return None
    picture = largest_part(small > threshold)
    best = best_outline(picture, resized, small)
    ratio = np.array([width / size[0], height / size[1]])
    if best.circle is None:
        corners_bright = (corners(small) > threshold).sum() >= 3
        box = _full_box(sides_of(picture), ratio)
        centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        return FieldOfView(centre, float("inf"), box) if corners_bright or fills(picture) else None
    x, y, radius, _ = best.circle
    sides = cut_in_the_dark(best, picture, small)
    centre = ((x + 0.5) * ratio[0] - 0.5, (y + 0.5) * ratio[1] - 0.5)
    return FieldOfView(centre, float(radius * ratio.mean()), _full_box(sides, ratio))


def _full_box(sides: list[float], ratio: Array) -> tuple[float, float, float, float]:
    """Outermost pixels inside sides given at working size, in pixels of the full image."""
    x0, y0, x1, y1 = (np.array(sides) + 0.5) * np.tile(ratio, 2)
    return float(x0), float(y0), float(x1) - 1, float(y1) - 1


def why_no_field(image: npt.NDArray[np.uint8]) -> str:
    """Why no field of view is found in an image (h, w, 3), in words."""
    light = np.percentile(image[::8, ::8].max(axis=2), 95)
    return TOO_DARK if light < LEAST_LIGHT else NO_BORDER


class FieldOfViewFinder:
    """The field of view of a stream of images: found once, and again if the picture no longer fits it."""

    RETRY_EVERY = 30  # images between attempts if there is no disc
    REFRESH_EVERY = (
        120  # images after which the disc is searched again: the camera rotates and shifts on the eyepiece
    )
    CHECK_EVERY = 4  # images between checks for picture outside the disc, and for none along its rim
    MISFITS = 3  # failed checks in a row after which the disc is searched again

    def __init__(self) -> None:
        self._field: FieldOfView | None = None
        self._shape: tuple[int, ...] = ()
        self._age = 0
        self._misfits = 0
        self._light_surround = False

    def find(self, image: npt.NDArray[np.uint8]) -> FieldOfView | None:
        """The field of view of the stream's next image (h, w, 3); None until an image is bright enough."""
        if image.shape != self._shape:
            self._field, self._shape, self._age, self._misfits = None, image.shape, -1, 0
        self._age += 1
        if self._field is not None and np.isfinite(self._field.radius):
            if self._age % self.CHECK_EVERY == 0:
                self._misfits = self._misfits + 1 if self._no_longer_fits(image) else 0
            if self._misfits < self.MISFITS and self._age % self.REFRESH_EVERY:
                return self._field
        elif self._field is not None and self._age % self.RETRY_EVERY:
            return self._field
        self._misfits = 0
        found = find_field_of_view(image)
        if found is not None:
            self._field = found
            # A light surround looks like picture outside the disc from the first.
            self._light_surround = bool(np.isfinite(found.radius)) and self._misfit(image)[0]
        return self._field

    def _misfit(self, image: npt.NDArray[np.uint8]) -> tuple[bool, bool]:
        """Whether there is picture well outside the disc, and whether there is none along its rim."""
        assert self._field is not None
        step = max(1, min(image.shape[:2]) // 40)
        blue, green, red = np.moveaxis(image[step // 2 :: step, step // 2 :: step], 2, 0)
        grid = np.maximum(np.maximum(blue, green), red)
        outside, rim = _outside_and_rim(self._field, (grid.shape[0], grid.shape[1]), step)
        # A gap crosses the rim in two places and leaves most of it lit.
        return (
            bool(outside.any() and (grid[outside] > 60).mean() > 0.1),
            bool(rim.any() and (grid[rim] < 16).mean() > 0.6),
        )

    def _no_longer_fits(self, image: npt.NDArray[np.uint8]) -> bool:
        """Whether an image shows, on a coarse grid, that the disc is another one."""
        beyond, dark_rim = self._misfit(image)
        return dark_rim or (beyond and not self._light_surround)


@lru_cache(maxsize=4)
def _outside_and_rim(field: FieldOfView, shape: tuple[int, int], step: int) -> tuple[Mask, Mask]:
    """Which of every `step`-th pixel of every `step`-th line lie well outside a disc, and at its rim."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]] * step + step // 2
    away = np.hypot(columns - field.centre[0], rows - field.centre[1]) / field.radius
    return away > 1.05, (away > 0.8) & (away < 0.97)


@lru_cache(maxsize=4)
def sparse_inside(field: FieldOfView, shape: tuple[int, int]) -> Mask:
    """Which of every 16th pixel of every 16th line, from the 8th on, lie inside the field."""
    rows, columns = np.mgrid[8 : shape[0] : 16, 8 : shape[1] : 16]
    return np.asarray(field.depth_inside(np.stack([columns, rows], axis=-1)) > 0)
