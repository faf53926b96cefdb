"""Sharpness of the border of a dark part of the image, which distinguishes a gap from shade."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.image.field_of_view import FieldOfView

AROUND = 10  # [px at working size] on either side of the border in which its sharpness is measured
ALONG = 60.0  # [px at working size] on either side of the section over which the border is measured
MOST_LINES = 64  # across the border of a side
LEAST_LINES = 8
SHARP = 3  # [px at working size] over which a sharp edge rises
LEAST_RANGE = 4.0  # [grey levels]: less is noise
FACING = 0.5  # [-] cosine to the section from which a piece of the border belongs to one of its sides
BEYOND = 6  # [px at working size] from the border, within which no instrument or glare may be
REACH = 12  # [px at working size] of the smoothing of a mask
INSIDE = 2.0  # [px at working size] inside the field, where a line must end


def border_sharpness(
    part: Mask, centre: Array, across: Array, value: Image, foreign: Mask, field: FieldOfView, scale: float
) -> Array:
    """Fraction (2,) of the rise across the border that falls within a few pixels, on each side of a section.

    It is the median over lines across the border of the dark `part` (h, w), since a single place can be sharp
    in the texture of a shaded flank, or blurred by drifting debris. All inputs are at working size, `scale`
    times the full size: the section's centre (2,) [px] and unit vector (2,) towards side 1, brightness and
    instruments and glare (h, w). A side with hardly any visible border has 0.
    """
    border, outward = _border(part)
    ends = (border + AROUND * outward + 0.5) / scale - 0.5
    column, row = np.rint(border + BEYOND * outward).astype(int).T
    clear = ~foreign[row.clip(0, part.shape[0] - 1), column.clip(0, part.shape[1] - 1)]
    clear &= field.depth_inside(ends) * scale > INSIDE
    clear &= np.abs((border - centre) @ np.array([-across[1], across[0]])) < ALONG
    smooth = cv2.GaussianBlur(value, (0, 0), 1.0).astype(np.float32)
    sharpness = np.zeros(2)
    for side, towards in enumerate((-across, across)):
        chosen = np.flatnonzero(clear & (outward @ towards > FACING) & ((border - centre) @ towards > 0.0))
        if len(chosen) >= LEAST_LINES:
            if len(chosen) > MOST_LINES:
                chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_LINES).astype(int)]
            sharpness[side] = _sharpness(smooth, border[chosen], outward[chosen])
    return sharpness


def _border(part: Mask) -> tuple[Array, Array]:
    """Pixels (n, 2) of the border of a part (h, w), and the unit vectors (n, 2) out of it there."""
    # Only the part's own box is looked at, with the reach of the smoothing.
    x, y, width, height = cv2.boundingRect(part.astype(np.uint8))
    x0, y0 = max(x - REACH, 0), max(y - REACH, 0)
    box = part[y0 : y + height + REACH, x0 : x + width + REACH]
    contours, _ = cv2.findContours(box.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    border = np.concatenate([contour[:, 0] for contour in contours])
    # The border of a mask is a staircase: the direction is that of the smoothed mask.
    soft = cv2.GaussianBlur(box.astype(np.float32), (0, 0), 2.0)
    column, row = border.T
    outward = -np.stack(
        [cv2.Sobel(soft, cv2.CV_32F, 1, 0)[row, column], cv2.Sobel(soft, cv2.CV_32F, 0, 1)[row, column]],
        axis=1,
    ).astype(np.float64)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return border + np.array([x0, y0], np.float64), outward / np.maximum(length, 1e-6)


def _sharpness(smooth: npt.NDArray[np.float32], border: Array, outward: Array) -> float:
    """Median over lines of the largest outward rise in SHARP pixels, relative to the range (n, 2)."""
    steps = np.arange(-AROUND, AROUND + 1)[:, None]
    places = (border[:, None] + steps * outward[:, None]).astype(np.float32)
    lines = cv2.remap(smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    rise = (lines[:, SHARP:] - lines[:, :-SHARP]).max(axis=1)
    return float(np.median(rise / np.maximum(np.ptp(lines, axis=1), LEAST_RANGE)))
