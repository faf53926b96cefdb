"""The outline of the picture in an image: its circle and its sides, by brightness, surround and edges."""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.image.disc import INLIER_DISTANCE, Circle, fit_circle, rim_lit

Brightness = npt.NDArray[np.uint8]

LEAST_LIGHT = 16.0  # [grey levels] above black, of the brighter part of a picture
LOOSE = 4.0  # [px at working size] within which points lie on the circle of a stretched picture
MOST_POINTS = 300  # of edges that are looked at
BLACK = 24.0  # [grey levels] up to which a surround is black: that of limited-range video is 16
EVEN = 3.0  # [grey levels] by which a corner of an even surround differs from its colour
APART = 10  # [grey levels] from the surround, from which a pixel belongs to the picture
FILLED = 0.7  # of a disc, that differs from an even surround: a gap may look like it
LEAST_PICTURE = 0.05  # of an image with an even surround
LEAST_CUT, CURVED_CUT = 0.03, 0.08  # of the radius: black beyond a cut, and how far a curved one reaches
STRAIGHT_SHARE = 0.25  # of a side's rows or columns; a disc's own extreme has less within a pixel


def brightness(image: Brightness) -> Brightness:
    """Largest channel of each pixel of an image (h, w, 3): the gap is dark in all, blood only in two."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)


class Outline(NamedTuple):
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


def best_outline(picture: Mask, resized: Image, small: Brightness) -> Outline:
    """The circle around a picture; where it is not sure, one by other signs that is, if there is any.

    The other signs: an even surround that is not black, edges, a disc that was stretched.
    """
    apart = _apart_from_surround(resized)
    if apart is not None:
        other = _outlined(largest_part(apart > APART), apart)
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
            other = Outline(circle, best.sides, small)
            if other.is_sure(rule):
                return other
    return best


def _outlined(picture: Mask, small: Brightness) -> Outline:
    """The circle around a picture, as an image shows it."""
    boundary, straight = _boundary(picture)
    # Only a straight side cuts the disc; if the picture just ends early, the gap reaches the rim.
    frame = [-0.5, -0.5, small.shape[1] - 0.5, small.shape[0] - 0.5]
    sides = [cut if cuts else end for cut, cuts, end in zip(sides_of(picture), straight, frame, strict=True)]
    return Outline(fit_circle(boundary), sides, small)


def cut_in_the_dark(outline: Outline, picture: Mask, small: Brightness) -> list[float]:
    """Sides of an outline, and those where the disc ends in the black of the surround along a curve.

    There, rows (or columns) of the disc are black to the last pixel, up to where the picture begins
    nearly all along. A gap at the rim leaves tissue beside it, or is not as dark as the surround.
    """
    assert outline.circle is not None
    x, y, radius, _ = outline.circle
    rows, columns = np.ogrid[: small.shape[0], : small.shape[1]]
    away = np.hypot(columns - x, rows - y)
    disc, outside = away < radius - 1.0, small[away > 1.05 * radius]
    if not outside.size:
        return outline.sides
    black = float(np.percentile(outside, 75)) + 3.0
    sides = list(outline.sides)
    frame = [-0.5, -0.5, small.shape[1] - 0.5, small.shape[0] - 0.5]
    for side, axis, backwards in ((0, 0, False), (1, 1, False), (2, 0, True), (3, 1, True)):
        if sides[side] != frame[side]:
            continue
        size = disc.sum(axis=axis)
        lines = np.flatnonzero(size)[:: -1 if backwards else 1]
        lit = (picture & disc).sum(axis=axis)[lines] / size[lines]
        dark = int((lit > 0.02).argmax())
        begin = int((lit > 0.5).argmax())
        soon = begin + max(2, round(CURVED_CUT * radius))
        if dark < LEAST_CUT * radius or begin - dark > CURVED_CUT * radius or lit[begin:soon].max() < 0.85:
            continue
        segment = (small if axis else small.T)[np.sort(lines[:dark])][
            (disc if axis else disc.T)[np.sort(lines[:dark])]
        ]
        if np.percentile(segment, 90) <= black:
            sides[side] = lines[begin] + (0.5 if backwards else -0.5)
    return sides


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
    """Whether most of a circle differs from the surround: it is not a ring on tissue."""
    rows, columns = np.ogrid[: apart.shape[0], : apart.shape[1]]
    inside = np.hypot(columns - circle.x, rows - circle.y) < circle.radius
    return bool((apart[inside] > APART).mean() > FILLED)


def _surround_is_dark(small: Brightness, circle: Circle) -> bool:
    """Whether outside a circle the image is mostly darker than half of what is inside."""
    rows, columns = np.ogrid[: small.shape[0], : small.shape[1]]
    away = np.hypot(columns - circle.x, rows - circle.y)
    inside, outside = small[away < 0.97 * circle.radius], small[away > 1.04 * circle.radius]
    return bool(outside.size and np.percentile(outside, 70) < 0.5 * np.median(inside))


def corners(small: Brightness) -> npt.NDArray[np.float64]:
    """Median brightness of the four corners."""
    n = max(2, min(small.shape) // 20)
    parts = (small[:n, :n], small[:n, -n:], small[-n:, :n], small[-n:, -n:])
    return np.array([np.median(part) for part in parts])


def picture_threshold(small: Brightness) -> float | None:
    """Brightness threshold between picture and surround; None if there is no picture."""
    dark = float(corners(small).min())
    bright = float(np.percentile(small, 95))
    if bright - min(dark, BLACK) < LEAST_LIGHT:
        return None
    # A brighter corner belongs to the picture.
    dark = min(dark, BLACK)
    return dark + max(6.0, 0.06 * (bright - dark))


def largest_part(picture: Mask) -> Mask:
    """The largest connected part, closed: captions and symbols beside the disc do not belong to it."""
    closed = cv2.morphologyEx(picture.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        return picture
    # A gap may cut the disc in two: parts of a tenth of the largest belong to it as well.
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas > 0.1 * areas.max()))


def fills(picture: Mask) -> bool:
    """Whether the picture fills its bounding box: a picture without a disc."""
    rows, columns = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
    inside = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return bool(corners(inside.astype(np.uint8)).sum() >= 3)


def sides_of(picture: Mask) -> list[float]:
    """Left, top, right and bottom side of the picture; rows or columns of isolated pixels do not count."""
    columns = np.flatnonzero(picture.sum(axis=0) >= 2)
    rows = np.flatnonzero(picture.sum(axis=1) >= 2)
    return [columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5]


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
    x0, y0, x1, y1 = sides_of(picture)
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
