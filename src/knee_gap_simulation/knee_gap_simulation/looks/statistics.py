"""Statistics of pictures of a joint, and how well a simple classifier separates renders from real ones."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.scope.imaging import ByteImage

# What is measured of each picture inside its field, after that was scaled to the same size.
FEATURES = (
    "(R - B) / max, median",
    "(G - B) / max, median",
    "(R - B) / max, 95 %",
    "saturation, median",
    "saturation, 95 %",
    "brightness, mean",
    "brightness, deviation",
    "clipped [%]",
    "dark [%]",
    "gradient, median",
    "gradient, 95 %",
    "detail, median",
)
_SIDE_PX = 256
_LIT = 28
_FOLDS, _REPEATS = 5, 20
_SHRINKAGE = 0.15


def features(image: ByteImage) -> Array:
    """The `FEATURES` of a picture (h, w, 3) bgr8; NaN if it shows no field."""
    picture, inside = _field(image)
    if not inside.any():
        return np.full(len(FEATURES), np.nan)
    blue, green, red = (picture[..., k].astype(np.float64) for k in range(3))
    most = picture.max(axis=-1).astype(np.float64)
    least = picture.min(axis=-1).astype(np.float64)
    lit = inside & (most >= 60.0)
    lit = lit if lit.any() else inside
    scale = np.maximum(most, 1.0)
    warm, saturation = (red - blue) / scale, (most - least) / scale
    grey = cv2.GaussianBlur(picture, (0, 0), 1.2).astype(np.float64).mean(axis=-1)
    slope = np.hypot(*np.gradient(grey))
    detail = np.abs(grey - cv2.GaussianBlur(grey, (0, 0), 3.0))
    return np.array(
        [
            np.median(warm[lit]),
            np.median(((green - blue) / scale)[lit]),
            np.percentile(warm[lit], 95.0),
            np.median(saturation[lit]),
            np.percentile(saturation[lit], 95.0),
            most[inside].mean(),
            most[inside].std(),
            100.0 * (most[inside] >= 250.0).mean(),
            100.0 * (most[inside] < 45.0).mean(),
            np.median(slope[inside]),
            np.percentile(slope[inside], 95.0),
            np.median(detail[inside]),
        ]
    )


def separability(first: Array, second: Array, seed: int = 0) -> float:
    """Cross-validated balanced accuracy of a linear discriminant between features (n, k) and (m, k).

    0.5 is chance. The discriminant is shrunk, since there are few pictures; folds are drawn several times.
    """
    rng = np.random.default_rng(seed)
    rates = []
    for _ in range(_REPEATS):
        folds = [np.arange(len(group)) % _FOLDS for group in (first, second)]
        for fold in folds:
            rng.shuffle(fold)
        right: tuple[list[bool], list[bool]] = ([], [])
        for k in range(_FOLDS):
            weights, limit = _discriminant(first[folds[0] != k], second[folds[1] != k])
            right[0].extend(first[folds[0] == k] @ weights < limit)
            right[1].extend(second[folds[1] == k] @ weights >= limit)
        rates.append(0.5 * (np.mean(right[0]) + np.mean(right[1])))
    return float(np.mean(rates))


def table(groups: dict[str, Array]) -> str:
    """The median and the 10-90 % range of every feature, a column for each group of pictures (n, k)."""
    head = (
        "| in the field | " + " | ".join(f"{name} ({len(values)})" for name, values in groups.items()) + " |"
    )
    lines = [head, "|---|" + "---|" * len(groups)]
    for index, feature in enumerate(FEATURES):
        cells = []
        for values in groups.values():
            low, middle, high = np.percentile(values[:, index], [10.0, 50.0, 90.0])
            digits = 2 if max(abs(low), abs(high)) < 10.0 else 0
            cells.append(f"{middle:.{digits}f} ({low:.{digits}f} .. {high:.{digits}f})")
        lines.append(f"| {feature} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def known(pictures: Sequence[ByteImage]) -> Array:
    """Features (n, k) of the pictures that show a field."""
    rows = np.array([features(picture) for picture in pictures]).reshape(-1, len(FEATURES))
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _field(image: ByteImage) -> tuple[ByteImage, npt.NDArray[np.bool_]]:
    """The picture cropped to its field and scaled to ``_SIDE_PX``, and which pixels lie well inside it."""
    bright = (image.max(axis=-1) > _LIT).astype(np.uint8)
    bright = cv2.morphologyEx(bright, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright)
    if count < 2:
        return image, np.zeros(image.shape[:2], bool)
    largest = 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))
    x, y, width, height = (int(value) for value in boxes[largest, :4])
    # The hull closes dark openings that reach the rim.
    points = cv2.findNonZero((labels == largest).astype(np.uint8))
    hull = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(points), (1,))
    scale = _SIDE_PX / max(width, height)
    size = (max(8, round(scale * width)), max(8, round(scale * height)))
    crop = (slice(y, y + height), slice(x, x + width))
    picture = cv2.resize(image[crop], size, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(hull[crop], size, interpolation=cv2.INTER_NEAREST)
    inside = cv2.erode(inside, np.ones((9, 9), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    return np.asarray(picture, np.uint8), inside > 0


def _discriminant(first: Array, second: Array) -> tuple[Array, float]:
    """Weights (k,) and limit of Fisher's discriminant: below it the first group, above the second."""
    both = np.concatenate([first, second])
    middle, scale = both.mean(axis=0), np.maximum(both.std(axis=0), 1e-9)
    a, b = (first - middle) / scale, (second - middle) / scale
    spread = 0.5 * (np.cov(a.T) + np.cov(b.T))
    spread = (1.0 - _SHRINKAGE) * spread + _SHRINKAGE * np.eye(len(spread))
    weights = np.linalg.solve(spread, b.mean(axis=0) - a.mean(axis=0)) / scale
    return weights, float(weights @ (0.5 * (first.mean(axis=0) + second.mean(axis=0))))
