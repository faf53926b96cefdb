"""Detection of the field of view: the disc of the image that the scope fills."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.image.disc import INLIER_DISTANCE, Circle, fit_circle, rim_lit

Brightness = npt.NDArray[np.uint8]

WORKING_ROWS = 180  # image rows at which the disc is searched
LEAST_LIGHT = 16.0  # [grey levels] above black, of the brighter part of a picture
LOOSE = 4.0  # [px at working size] within which points lie on the circle of a stretched picture
MOST_POINTS = 300  # of edges that are looked at
BLACK = 24.0  # [grey levels] up to which a surround is black: that of limited-range video is 16
EVEN = 3.0  # [grey levels] by which a corner of an even surround differs from its colour
APART = 10  # [grey levels] from the surround, from which a pixel belongs to the picture
FILLED = 0.7  # of a disc, that differs from an even surround: a gap may look like it
LEAST_PICTURE = 0.05  # of an image with an even surround
STRAIGHT_SHARE = 0.25  # of a side's rows or columns; a disc's own extreme has less within a pixel

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


def brightness(image: Brightness) -> Brightness:
    """Largest channel of each pixel of an image (h, w, 3): the gap is dark in all, blood only in two."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)


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
    threshold = _picture_threshold(small)
    if threshold is None:
        return None
    picture = _largest_part(small > threshold)
    best = _best_outline(picture, resized, small)
    ratio = np.array([width / size[0], height / size[1]])
    if best.circle is None:
        corners_bright = (_corners(small) > threshold).sum() >= 3
        box = _full_box(_sides(picture), ratio)
        centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        return FieldOfView(centre, float("inf"), box) if corners_bright or _fills(picture) else None
    x, y, radius, _ = best.circle
    centre = ((x + 0.5) * ratio[0] - 0.5, (y + 0.5) * ratio[1] - 0.5)
    return FieldOfView(centre, float(radius * ratio.mean()), _full_box(best.sides, ratio))


class _Outline(NamedTuple):
    """A circle, if one is found, the sides that cut it [px at working size], and the image that shows it."""

    circle: Circle | None
    sides: list[float]
    shown_by: Brightness

    def is_sure(self, *rules: tuple[float, float]) -> bool:
        """Whether a rule holds: shares of the points that lie on the circle, and of its lit directions."""
        if self.circle is None:
            return False
        lit = rim_lit(self.shown_by, self.circle)
        return any(self.circle.share >= share and lit >= least_lit for share, least_lit in rules)


def _best_outline(picture: Mask, resized: Image, small: Brightness) -> _Outline:
    """The circle around a picture; where it is not sure, one by other signs that is, if there is any.

    The other signs: an even surround that is not black, edges, a disc that was stretched.
    """
    apart = _apart_from_surround(resized)
    if apart is not None:
        other = _outlined(_largest_part(apart > APART), apart)
        if other.is_sure((0.8, 0.6)) and other.circle is not None and _is_filled(apart, other.circle):
            return other
    best = _outlined(picture, small)
    if best.is_sure((0.57, 0.6), (0.75, 0.45)):
        return best
    edges, boundary = _edge_points(small), _boundary(picture)[0]
    for points, within, rule in (
        (boundary, LOOSE, (0.9, 0.7)),
        (edges, INLIER_DISTANCE, (0.4, 0.75)),
        (edges, LOOSE, (0.6, 0.7)),
        (boundary, LOOSE, (0.8, 0.9)),
    ):
        circle = fit_circle(points[:: 1 + len(points) // MOST_POINTS], within)
        if circle is not None and _surround_is_dark(small, circle):
            other = _Outline(circle, best.sides, small)
            if other.is_sure(rule):
                return other
    return best


def _outlined(picture: Mask, small: Brightness) -> _Outline:
    """The circle around a picture, as an image shows it."""
    boundary, straight = _boundary(picture)
    # Only a straight side cuts the disc; if the picture just ends early, the gap reaches the rim.
    frame = [-0.5, -0.5, small.shape[1] - 0.5, small.shape[0] - 0.5]
    sides = [cut if cuts else end for cut, cuts, end in zip(_sides(picture), straight, frame, strict=True)]
    return _Outline(fit_circle(boundary), sides, small)


def _apart_from_surround(resized: Image) -> Brightness | None:
    """Difference of each pixel from an even surround that is not black; None if there is none."""
    n = max(2, min(resized.shape[:2]) // 20)
    parts = [
        resized[rows, columns].reshape(-1, 3)
        for rows in (slice(n), slice(-n, None))
        for columns in (slice(n), slice(-n, None))
    ]
    colours = np.array([np.median(part, axis=0) for part in parts])
    even = np.array(
        [np.abs(part - colour).max(axis=1).mean() < EVEN for part, colour in zip(parts, colours, strict=True)]
    )
    if even.sum() < 3:
        return None
    surround = np.median(colours[even], axis=0)
    alike = (np.abs(colours - surround).max(axis=1) < 2 * EVEN) & even
    if alike.sum() < 3 or surround.max() <= BLACK:
        return None
    difference = cv2.absdiff(resized, np.full_like(resized, surround.astype(np.uint8)))
    apart = np.asarray(cv2.medianBlur(brightness(np.asarray(difference, np.uint8)), 3), np.uint8)
    return apart if (apart > APART).mean() > LEAST_PICTURE else None


def _edge_points(small: Brightness) -> Array:
    """Points (n, 2) at which rows and columns, from outside inwards, first become much brighter."""
    height, width = small.shape
    least = 4.0 * max(8.0, 0.1 * float(np.percentile(small, 95)))
    rows, columns = np.arange(height), np.arange(width)
    points = []
    for inwards, axis in (((1, 0), 1), ((0, 1), 0)):
        slope = cv2.Sobel(small, cv2.CV_16S, *inwards)
        for way in (1, -1):
            rising = slope * way > least
            if way < 0:
                rising = np.flip(rising, axis)
            first = rising.argmax(axis=axis)
            known = rising.any(axis=axis)
            if way < 0:
                first = small.shape[axis] - 1 - first
            along = rows if axis else columns
            pair = (first, along) if axis else (along, first)
            points.append(np.stack(pair, axis=1)[known])
    found = np.concatenate(points).astype(np.float64)
    inner = ((found > 1) & (found < [width - 2, height - 2])).all(axis=1)
    return np.asarray(found[inner])


def _is_filled(apart: Brightness, circle: Circle) -> bool:
    """Whether most of a circle differs from the surround: it is no ring on tissue."""
    rows, columns = np.ogrid[: apart.shape[0], : apart.shape[1]]
    inside = np.hypot(columns - circle.x, rows - circle.y) < circle.radius
    return bool((apart[inside] > APART).mean() > FILLED)


def _surround_is_dark(small: Brightness, circle: Circle) -> bool:
    """Whether outside a circle the image is mostly darker than half of what is inside."""
    rows, columns = np.ogrid[: small.shape[0], : small.shape[1]]
    away = np.hypot(columns - circle.x, rows - circle.y)
    inside, outside = small[away < 0.97 * circle.radius], small[away > 1.04 * circle.radius]
    return bool(outside.size and np.percentile(outside, 70) < 0.5 * np.median(inside))


def _corners(small: Brightness) -> npt.NDArray[np.float64]:
    """Median brightness of the four corners."""
    n = max(2, min(small.shape) // 20)
    parts = (small[:n, :n], small[:n, -n:], small[-n:, :n], small[-n:, -n:])
    return np.array([np.median(part) for part in parts])


def _picture_threshold(small: Brightness) -> float | None:
    """Brightness threshold between picture and surround; None if there is no picture."""
    dark = float(_corners(small).min())
    bright = float(np.percentile(small, 95))
    if bright - min(dark, BLACK) < LEAST_LIGHT:
        return None
    # A brighter corner belongs to the picture.
    dark = min(dark, BLACK)
    return dark + max(6.0, 0.06 * (bright - dark))


def _largest_part(picture: Mask) -> Mask:
    """The largest connected part, closed: captions and symbols beside the disc do not belong to it."""
    closed = cv2.morphologyEx(picture.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        return picture
    # A gap may cut the disc in two: parts of a tenth of the largest belong to it as well.
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas > 0.1 * areas.max()))


def _fills(picture: Mask) -> bool:
    """Whether the picture fills its bounding box: a picture without a disc."""
    rows, columns = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
    inside = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return bool(_corners(inside.astype(np.uint8)).sum() >= 3)


def _sides(picture: Mask) -> list[float]:
    """Left, top, right and bottom side of the picture; rows or columns of isolated pixels do not count."""
    columns = np.flatnonzero(picture.sum(axis=0) >= 2)
    rows = np.flatnonzero(picture.sum(axis=1) >= 2)
    return [columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5]


def _full_box(sides: list[float], ratio: Array) -> tuple[float, float, float, float]:
    """Outermost pixels inside sides given at working size, in pixels of the full image."""
    x0, y0, x1, y1 = (np.array(sides) + 0.5) * np.tile(ratio, 2)
    return float(x0), float(y0), float(x1) - 1, float(y1) - 1


def _boundary(picture: Mask) -> tuple[Array, list[bool]]:
    """First and last pixels of every row and column (n, 2), and which sides of the picture are straight.

    Points on the border of the frame and on straight sides (letter-box bars) are left out.
    """
    height, width = picture.shape
    rows, columns = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
    left = picture[rows].argmax(axis=1)
    right = width - 1 - picture[rows, ::-1].argmax(axis=1)
    top = picture[:, columns].argmax(axis=0)
    bottom = height - 1 - picture[::-1, columns].argmax(axis=0)
    # Half a pixel outwards: the boundary lies between the last pixel of the picture and the next.
    x0, y0, x1, y1 = _sides(picture)
    parts, straight = [], []
    for place, along, side, outwards in (
        (left, rows, x0, -0.5),
        (top, columns, y0, -0.5),
        (right, rows, x1, 0.5),
        (bottom, columns, y1, 0.5),
    ):
        border = place + outwards
        on_side = np.abs(border - side) < 1.1
        straight.append(bool(on_side.mean() > STRAIGHT_SHARE))
        kept = ~on_side if straight[-1] else np.ones_like(on_side)
        vertical = place is left or place is right
        parts.append(np.stack([border, along] if vertical else [along, border], axis=1)[kept])
    points = np.concatenate(parts)
    inner = (points[:, 0] > 1) & (points[:, 0] < width - 2) & (points[:, 1] > 1) & (points[:, 1] < height - 2)
    return points[inner], straight


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
        grid = image[step // 2 :: step, step // 2 :: step].max(axis=2)
        rows, columns = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]] * step + step // 2
        away = np.hypot(columns - self._field.centre[0], rows - self._field.centre[1]) / self._field.radius
        outside, rim = away > 1.05, (away > 0.8) & (away < 0.97)
        # A gap crosses the rim in two places and leaves most of it lit.
        return (
            bool(outside.any() and (grid[outside] > 60).mean() > 0.1),
            bool(rim.any() and (grid[rim] < 16).mean() > 0.6),
        )

    def _no_longer_fits(self, image: npt.NDArray[np.uint8]) -> bool:
        """Whether an image shows, on a coarse grid, that the disc is another one."""
        beyond, dark_rim = self._misfit(image)
        return dark_rim or (beyond and not self._light_surround)
