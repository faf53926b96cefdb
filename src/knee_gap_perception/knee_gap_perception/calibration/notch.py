"""The notch at the border of the field of view, by which a surgeon sees how an oblique scope is turned."""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_perception.calibration.rigid import Array
from knee_gap_perception.field_of_view import FieldOfView, brightness

STEPS = 1440  # around the border: a quarter of a degree
INNER, OUTER = 0.86, 1.10  # band that is looked at, in radii of the field of view
LEVEL = 0.25  # between the black surround and the brightness at the border
BASELINE = 161  # steps (40 degrees) over which the border itself runs smoothly
MIN_DEPTH = 0.012  # of the radius
WIDTH = (np.radians(1.5), np.radians(16.0))
NOTCH_SIGMA = np.radians(
    0.1
)  # of an angle found: it was 0.06 deg on rendered pictures, real notches are blunter
MIN_LEAD = 2.0  # times the area of the next candidate


class Notch(NamedTuple):
    """`angle` [rad] of the notch about the centre of the field, from the image's x to its y, in (-pi, pi].

    `depth` is how far it reaches into the field, in its radii; negative where it reaches out of it.
    """

    angle: float
    depth: float


def find_notch(image: npt.NDArray[np.uint8], field: FieldOfView) -> Notch | None:
    """The notch of an image (h, w, 3); None where the border shows none, or several that look alike."""
    if not np.isfinite(field.radius):
        return None
    border = _border(image, field)
    if border is None:
        return None
    known = np.isfinite(border)
    if known.mean() < 0.7:
        return None
    filled = np.interp(np.arange(STEPS), np.flatnonzero(known), border[known], period=STEPS)
    depth = _baseline(filled) - filled
    depth[~known] = 0.0
    runs = sorted(_runs(depth), key=lambda run: -abs(float(depth[run].sum())))
    fitting = [run for run in runs if WIDTH[0] <= len(run) * 2 * np.pi / STEPS <= WIDTH[1]]
    if not fitting or fitting[0] is not runs[0]:
        return None
    areas = [abs(float(depth[run].sum())) for run in runs]
    if len(areas) > 1 and areas[0] < MIN_LEAD * areas[1]:
        return None
    weight = np.abs(depth[fitting[0]])
    angles = fitting[0] * 2 * np.pi / STEPS
    centre = np.arctan2(weight @ np.sin(angles), weight @ np.cos(angles))
    return Notch(float(centre), float(depth[fitting[0]][weight.argmax()]))


def _border(image: npt.NDArray[np.uint8], field: FieldOfView) -> Array | None:
    """Radius at which each direction first shows light, from outside in (STEPS,); NaN outside the image."""
    light = cv2.GaussianBlur(brightness(image), (0, 0), 1.0).astype(np.float32)
    angles = np.arange(STEPS) * 2 * np.pi / STEPS
    count = max(16, round((OUTER - INNER) * field.radius * 2))
    radii = np.linspace(OUTER, INNER, count)
    x = field.centre[0] + field.radius * np.outer(np.cos(angles), radii)
    y = field.centre[1] + field.radius * np.outer(np.sin(angles), radii)
    band = cv2.remap(
        light, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    box = field.box
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    surround = band[(radii > 1.03)[None] & inside]
    # Where the disc touches the frame there is no surround to look at; black is then 0.
    black = float(np.median(surround)) if surround.size > STEPS else 0.0
    # What each direction shows just inside the border, a notch's width smoothed away.
    bright = np.median(band[:, radii < 0.93], axis=1)
    bright = cv2.blur(np.tile(bright, 3)[None].astype(np.float32), (61, 1))[0, STEPS : 2 * STEPS]
    if np.percentile(bright, 80) < black + 15:
        return None
    level = black + LEVEL * np.maximum(bright - black, 12.0)
    lit = (band > level[:, None]) & inside
    first = lit.argmax(axis=1)
    border = np.where(lit.any(axis=1), radii[first], INNER)
    # Light that is cut by the frame's side, rather than by the field stop, says nothing of the border.
    cut = ~inside[np.arange(STEPS), np.maximum(first - 2, 0)] & (first > 0)
    border[cut | ~inside.any(axis=1) | (bright < black + 8)] = np.nan
    return np.asarray(border, dtype=np.float64)


def _baseline(border: Array) -> Array:
    """Running median around the circle."""
    half = BASELINE // 2
    wrapped = np.concatenate([border[-half:], border, border[:half]])
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(wrapped, BASELINE), axis=1))


def _runs(depth: Array) -> list[npt.NDArray[np.intp]]:
    """Directions, as runs of steps, in which the border leaves its baseline to one side."""
    runs = []
    for side in (depth > MIN_DEPTH, depth < -MIN_DEPTH):
        if side.all() or not side.any():
            continue
        start = int(np.flatnonzero(~side)[0])
        order = (np.arange(STEPS) + start) % STEPS
        edges = np.diff(np.concatenate([[0], side[order].astype(int), [0]]))
        for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            runs.append(order[begin:end])
    return runs
