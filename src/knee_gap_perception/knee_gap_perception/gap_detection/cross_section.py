"""The section of the gap through which an instrument would pass, and the edges on both sides of it."""

from dataclasses import dataclass

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.gap_detection.border_sharpness import border_sharpness
from knee_gap_perception.image.field_of_view import FieldOfView

DIRECTIONS = 36  # across the gap, over half a turn
SMOOTHED = 4  # directions on either side over which widths are smoothed
STEP = 0.5  # [px at working size] between the samples of a ray
TISSUE_BEYOND = 6  # [px at working size] of tissue that must follow an edge
TRIES, TRIES_BESIDE_SHAFTS = 3, 6  # places along a part
APART = 12  # [px at working size] between an instrument's shaft and the centre of a section
CANDIDATES = 4  # dark parts examined, largest first


@dataclass(frozen=True)
class Section:
    """The largest inscribed disc (centre [px], radius [px]) and the two edges across it (2, 2) [px].

    `levels` (3,) is the brightness of gap, tissue beyond edge 0 and tissue beyond edge 1; `contrast` (2,) the
    step at each edge relative to the tissue's brightness; `sharpness` (2,) that of the border on each side
    (`border_sharpness`). `part` (h, w) is the dark part that it leads through, at working size. Lengths are
    in pixels of the full image.
    """

    centre: Array
    radius: float
    edges: Array
    contrast: Array
    levels: Array
    sharpness: Array
    part: Mask | None = None

    @property
    def across(self) -> Array:
        """Unit vector (2,) in the image from edge 0 to edge 1."""
        span = self.edges[1] - self.edges[0]
        return np.asarray(span / np.linalg.norm(span))


def find_section(
    dark: Mask,
    value: Image,
    foreign: Mask,
    field: FieldOfView,
    scale: float,
    region: tuple[Array, float],
    shafts: Mask | None = None,
) -> Section | None:
    """The best section through the dark pixels; None where no dark part has tissue on both sides.

    `dark`, `value` (brightness) and `foreign` (instruments and glare) are (h, w) at working size, `scale`
    times the full size; `region` is the centre [px] and radius [px] of the region of interest in the full
    image, which must contain the disc's centre. Of several dark parts, the one with the largest disc is
    chosen, with a preference for discs near the region's centre. Beside `shafts` (h, w) of instruments,
    which cross the gap or lie along it, no disc is chosen.
    """
    opened = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")[:CANDIDATES]
    rows, columns = np.ogrid[0 : dark.shape[0], 0 : dark.shape[1]]
    centre_small = (region[0] + 0.5) * scale - 0.5
    away2 = ((columns - centre_small[0]) ** 2 + (rows - centre_small[1]) ** 2) / (region[1] * scale) ** 2
    preference = np.where(away2 <= 1.0, 1.0 - 0.8 * away2, 0.0)
    beside = None
    if shafts is not None and shafts.any():
        beside = cv2.dilate(shafts.astype(np.uint8), np.ones((2 * APART + 1, 2 * APART + 1), np.uint8)) > 0
        preference = np.where(beside, 0.0, preference)
    best: tuple[float, Section] | None = None
    for label in order if count > 1 else ():
        # A disc cannot be larger than its dark part.
        if best is not None and np.sqrt(stats[label, cv2.CC_STAT_AREA] / np.pi) + 1.0 < best[0]:
            break
        part = labels == label
        # Only the part's own box is looked at. The padding keeps the discs inside it.
        x, y, width, height = stats[label, :4]
        box = np.s_[y : y + height, x : x + width]
        distance = cv2.distanceTransform(
            cv2.copyMakeBorder(part[box].astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT), cv2.DIST_L2, 5
        )[1:-1, 1:-1]
        score = distance * preference[box]
        for _ in range(TRIES if beside is None else TRIES_BESIDE_SHAFTS):
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            if score[row, column] <= 1.0 or (best is not None and score[row, column] <= best[0]):
                break
            section = _section_through(
                np.array([x + column, y + row], float),
                float(distance[row, column]),
                part,
                value,
                foreign,
                field,
                scale,
            )
            if section is not None and (beside is None or _is_apart(section, beside, scale)):
                best = (float(score[row, column]), section)
                break
            # There is not tissue on one side here, or an instrument: search elsewhere along the same part.
            radius = max(6.0, float(distance[row, column]))
            away2 = (columns[:, box[1]] - x - column) ** 2 + (rows[box[0]] - y - row) ** 2
            score = np.where(away2 < radius**2, 0.0, score)
    return best[1] if best is not None else None


def _is_apart(section: Section, beside: Mask, scale: float) -> bool:
    """Whether both edges of a section lie outside a mask (h, w) at working size."""
    column, row = np.rint((section.edges + 0.5) * scale - 0.5).astype(int).T
    return not beside[row.clip(0, beside.shape[0] - 1), column.clip(0, beside.shape[1] - 1)].any()


def _section_through(
    centre: Array, radius: float, part: Mask, value: Image, foreign: Mask, field: FieldOfView, scale: float
) -> Section | None:
    """Narrowest line across the gap through a point at working size, with tissue at both ends."""
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    length = np.arange(0.0, 4.0 * radius + 20.0, STEP)
    reach = np.empty((DIRECTIONS, 2))
    # Rays that leave the frame end in a padding that is not a gap.
    padding = int(length[-1]) + 2
    padded = cv2.copyMakeBorder(
        part.astype(np.uint8), padding, padding, padding, padding, cv2.BORDER_CONSTANT
    )
    for side, sign in enumerate((-1.0, 1.0)):
        column, row = (
            np.rint(middle + sign * length * towards[:, None]).astype(np.int64) + padding
            for middle, towards in zip(centre, directions.T, strict=True)
        )
        tissue_there = padded[row, column] == 0
        first = np.where(tissue_there.any(axis=1), tissue_there.argmax(axis=1) * STEP, np.nan)
        beyond = centre + sign * (first[:, None] + TISSUE_BEYOND) * directions
        full = (beyond + 0.5) / scale - 0.5
        depth = np.where(np.isfinite(full).all(axis=1), field.depth_inside(np.nan_to_num(full)), -1.0)
        # An instrument or glare beside the gap is not an edge of it.
        column, row = np.rint(np.nan_to_num(beyond)).astype(int).T
        tissue = ~foreign[row.clip(0, part.shape[0] - 1), column.clip(0, part.shape[1] - 1)]
        reach[:, side] = np.where((depth > 0) & tissue, first, np.nan)
    width = reach.sum(axis=1)
    if not np.isfinite(width).any():
        return None
    narrowest = int(np.nanargmin(_smoothed(width)))
    ends = centre + np.array([[-1.0], [1.0]]) * reach[narrowest][:, None] * directions[narrowest]
    levels = _levels(centre, radius, ends, value)
    contrast = (levels[1:] - levels[0]) / np.maximum(levels[1:], 1.0)
    return Section(
        centre=(centre + 0.5) / scale - 0.5,
        radius=radius / scale,
        edges=(ends + 0.5) / scale - 0.5,
        contrast=contrast,
        levels=levels,
        sharpness=border_sharpness(part, centre, directions[narrowest], value, foreign, field, scale),
        part=part,
    )


def _smoothed(width: Array) -> Array:
    """Widths over half a turn (n,), smoothed over neighbouring directions; NaN stays NaN.

    Without smoothing, a nick in an edge makes some direction narrower than the one across the gap.
    """
    turns = np.stack([np.roll(width, shift) for shift in range(-SMOOTHED, SMOOTHED + 1)])
    known = np.isfinite(turns)
    level = np.where(known, turns, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(np.isfinite(width), level, np.nan)


def section_places(section: Section, scale: float) -> list[tuple[Array, int]]:
    """Places (2,) in the gap's middle and on the tissue beyond each edge, each with the half side of a patch.

    In pixels of the image reduced by `scale`.
    """
    centre, ends = (section.centre + 0.5) * scale - 0.5, (section.edges + 0.5) * scale - 0.5
    return _places(centre, section.radius * scale, ends)


def _places(centre: Array, radius: float, ends: Array) -> list[tuple[Array, int]]:
    outward = (ends - centre) / np.linalg.norm(ends - centre, axis=1, keepdims=True)
    beyond = ends + outward * TISSUE_BEYOND
    return [
        (centre, max(1, int(0.5 * radius))),
        (beyond[0], TISSUE_BEYOND // 2),
        (beyond[1], TISSUE_BEYOND // 2),
    ]


def _levels(centre: Array, radius: float, ends: Array, value: Image) -> Array:
    """Median brightness of the gap's middle and of the tissue beyond each end (3,)."""
    levels = []
    for (x, y), half in _places(centre, radius, ends):
        row, column = round(float(y)), round(float(x))
        patch = value[max(0, row - half) : row + half + 1, max(0, column - half) : column + half + 1]
        levels.append(float(np.median(patch)) if patch.size else 0.0)
    return np.array(levels)
