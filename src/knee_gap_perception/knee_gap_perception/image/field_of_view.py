"""Detection of the field of view: the disc of the image that the scope fills."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Mask

Brightness = npt.NDArray[np.uint8]

WORKING_ROWS = 180  # image rows at which the disc is searched
HYPOTHESES = 400  # circles through three boundary points
INLIER_DISTANCE = 1.2  # [px at working size]
STRAIGHT_SHARE = 0.25  # of a side's rows or columns; a disc's own extreme has less within a pixel
MINIMUM_ARC = np.radians(90)  # visible boundary needed to accept a circle


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
    """The field of view in an image (h, w, 3); None if the image is too dark."""
    height, width = image.shape[:2]
    scale = min(1.0, WORKING_ROWS / min(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    resized = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    small = np.asarray(cv2.medianBlur(brightness(resized), 3), dtype=np.uint8)
    threshold = _picture_threshold(small)
    if threshold is None:
        return None
    picture = _largest_part(small > threshold)
    boundary, straight = _boundary(picture)
    circle = _fit_circle(boundary)
    ratio = np.array([width / size[0], height / size[1]])
    if circle is None:
        corners_bright = (_corners(small) > threshold).sum() >= 3
        box = _full_box(_sides(picture), ratio)
        centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        return FieldOfView(centre, float("inf"), box) if corners_bright or _fills(picture) else None
    x, y, radius = circle
    # Only a straight side cuts the disc; if the picture just ends early, the gap reaches the rim.
    sides = [-0.5, -0.5, size[0] - 0.5, size[1] - 0.5]
    sides = [
        cut if cuts else frame for cut, cuts, frame in zip(_sides(picture), straight, sides, strict=True)
    ]
    centre = ((x + 0.5) * ratio[0] - 0.5, (y + 0.5) * ratio[1] - 0.5)
    return FieldOfView(centre, float(radius * ratio.mean()), _full_box(sides, ratio))


def _corners(small: Brightness) -> npt.NDArray[np.float64]:
    """Median brightness of the four corners."""
    n = max(2, min(small.shape) // 20)
    parts = (small[:n, :n], small[:n, -n:], small[-n:, :n], small[-n:, -n:])
    return np.array([np.median(part) for part in parts])


def _picture_threshold(small: Brightness) -> float | None:
    """Brightness threshold between picture and surround; None if there is no picture."""
    dark = float(_corners(small).min())
    bright = float(np.percentile(small, 95))
    if bright - min(dark, 24.0) < 16:
        return None
    # A surround is black up to the 16 of limited-range video; a brighter corner belongs to the picture.
    dark = min(dark, 24.0)
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


def _fit_circle(points: Array) -> tuple[float, float, float] | None:
    """Centre and radius of the circle on which most points lie; None if no circle fits them."""
    if len(points) < 40:
        return None
    triples = np.random.default_rng(0).integers(0, len(points), (HYPOTHESES, 3))
    circles = _circumcircles(points[triples])
    spread = np.ptp(points, axis=0).max()
    # The disc spans most of its own boundary box, or is cut by the frame and then larger.
    plausible = (circles[:, 2] > 0.3 * spread) & (circles[:, 2] < 1.2 * spread)
    circles = circles[plausible]
    if not len(circles):
        return None
    distance = np.hypot(points[:, 0] - circles[:, :1], points[:, 1] - circles[:, 1:2]) - circles[:, 2:]
    best = circles[(np.abs(distance) < INLIER_DISTANCE).sum(axis=1).argmax()]
    for _ in range(5):
        inliers = points[_on_circle(points, best)]
        if len(inliers) < 20:
            return None
        best = _least_squares_circle(inliers)
    inliers = points[_on_circle(points, best)]
    angle = np.arctan2(inliers[:, 1] - best[1], inliers[:, 0] - best[0])
    arc = np.unique(np.floor((angle + np.pi) / (2 * np.pi) * 72)).size / 72 * 2 * np.pi
    if arc < MINIMUM_ARC or len(inliers) < 0.35 * len(points):
        return None
    return float(best[0]), float(best[1]), float(best[2])


def _on_circle(points: Array, circle: Array) -> Mask:
    distance = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]
    return np.asarray(np.abs(distance) < INLIER_DISTANCE)


def _circumcircles(triples: Array) -> Array:
    """Circles (n, 3) through triples of points (n, 3, 2); NaN for points on a line."""
    a, b, c = np.moveaxis(triples, 1, 0)
    ab, ac = b - a, c - a
    cross = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    cross = np.where(np.abs(cross) < 1.0, np.nan, cross)
    ab2, ac2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    x = (ac[:, 1] * ab2 - ab[:, 1] * ac2) / cross
    y = (ab[:, 0] * ac2 - ac[:, 0] * ab2) / cross
    return np.stack([a[:, 0] + x, a[:, 1] + y, np.hypot(x, y)], axis=1)


def _least_squares_circle(points: Array) -> Array:
    """Circle (3,) through points (n, 2), least squares of the algebraic distance."""
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    design = np.stack([x, y, np.ones_like(x)], axis=1)
    solution = np.linalg.lstsq(design, x * x + y * y, rcond=None)[0]
    centre = solution[:2] / 2
    radius = np.sqrt(solution[2] + centre @ centre)
    return np.array([centre[0] + mean[0], centre[1] + mean[1], radius])


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

    def find(self, image: npt.NDArray[np.uint8]) -> FieldOfView | None:
        """The field of view of the stream's next image (h, w, 3); None until an image is bright enough."""
        if image.shape != self._shape:
            self._field, self._shape, self._age, self._misfits = None, image.shape, -1, 0
        self._age += 1
        if self._field is not None and np.isfinite(self._field.radius):
            if self._age % self.CHECK_EVERY == 0:
                self._misfits = self._misfits + 1 if self._misfit(image) else 0
            if self._misfits < self.MISFITS and self._age % self.REFRESH_EVERY:
                return self._field
        elif self._field is not None and self._age % self.RETRY_EVERY:
            return self._field
        self._misfits = 0
        found = find_field_of_view(image)
        if found is not None:
            self._field = found
        return self._field

    def _misfit(self, image: npt.NDArray[np.uint8]) -> bool:
        """Whether there is picture well outside the disc, or none along its rim, on a coarse grid."""
        assert self._field is not None
        step = max(1, min(image.shape[:2]) // 40)
        grid = image[step // 2 :: step, step // 2 :: step].max(axis=2)
        rows, columns = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]] * step + step // 2
        away = np.hypot(columns - self._field.centre[0], rows - self._field.centre[1]) / self._field.radius
        outside, rim = away > 1.05, (away > 0.8) & (away < 0.97)
        if outside.any() and (grid[outside] > 60).mean() > 0.1:
            return True
        # A gap crosses the rim in two places and leaves most of it lit.
        return bool(rim.any() and (grid[rim] < 16).mean() > 0.6)
