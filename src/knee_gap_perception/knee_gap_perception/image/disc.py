"""The circle on which most points of a border lie, and how much of it an image shows."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Mask

HYPOTHESES = 400  # circles through three boundary points
INLIER_DISTANCE = 1.2  # [px at working size]
FEWEST_POINTS = 40
MINIMUM_ARC = np.radians(90)  # visible boundary needed to accept a circle
CORNER_ARC = np.radians(40)  # needed if it shows in three quadrants, as in the corners of a zoomed picture
INLIER_SHARE = 0.35  # of the points
DIRECTIONS = 180  # in which the rim is looked at
STEP = 6.0  # [grey levels] by which the picture is brighter than the surround, to show the rim
ACROSS = 0.04  # of the radius, to either side of the rim, where both are looked at


class Circle(NamedTuple):
    """Centre and radius [px at working size], and the share of the points that lie on it."""

    x: float
    y: float
    radius: float
    share: float


def fit_circle(points: Array, within: float = INLIER_DISTANCE) -> Circle | None:
    """The circle on which most points (n, 2) lie, within a distance [px]; None if no circle fits them."""
    if len(points) < FEWEST_POINTS:
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
    best = circles[(np.abs(distance) < within).sum(axis=1).argmax()]
    for _ in range(5):
        inliers = points[_on_circle(points, best, within)]
        if len(inliers) < FEWEST_POINTS // 2:
            return None
        best = _least_squares_circle(inliers)
    inliers = points[_on_circle(points, best, within)]
    if len(inliers) < INLIER_SHARE * len(points) or not _arc_is_enough(inliers - best[:2]):
        return None
    return Circle(float(best[0]), float(best[1]), float(best[2]), len(inliers) / len(points))


def rim_lit(small: npt.NDArray[np.uint8], circle: Circle) -> float:
    """Share of a circle's directions in which an image (h, w) is brighter just inside it than just outside.

    Directions whose sides do not both lie in the image do not count; 0 if none do.
    """
    angle = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    across = max(2.0, ACROSS * circle.radius)
    sides = []
    for radius in (circle.radius - across, circle.radius + across):
        column = np.rint(circle.x + radius * np.cos(angle)).astype(int)
        row = np.rint(circle.y + radius * np.sin(angle)).astype(int)
        inside = (column >= 0) & (column < small.shape[1]) & (row >= 0) & (row < small.shape[0])
        value = small[row.clip(0, small.shape[0] - 1), column.clip(0, small.shape[1] - 1)]
        sides.append((inside, value.astype(np.int16)))
    (inner, light), (outer, dark) = sides
    seen = inner & outer
    return float((light - dark > STEP)[seen].mean()) if seen.any() else 0.0


def _arc_is_enough(offsets: Array) -> bool:
    """Whether points at offsets (n, 2) from a centre show enough of its circle."""
    angle = np.arctan2(offsets[:, 1], offsets[:, 0])
    bins = np.unique(np.floor((angle + np.pi) / (2 * np.pi) * 72))
    arc = bins.size / 72 * 2 * np.pi
    quadrants = np.unique(bins // 18, return_counts=True)[1]
    return bool(arc >= MINIMUM_ARC or (arc >= CORNER_ARC and (quadrants >= 2).sum() >= 3))


def _on_circle(points: Array, circle: Array, within: float) -> Mask:
    distance = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]
    return np.asarray(np.abs(distance) < within)


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
