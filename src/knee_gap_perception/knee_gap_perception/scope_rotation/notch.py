"""The notch at the border of the field of view, by which a surgeon sees how an oblique scope is turned.

It is a part of the field stop: of one shape, at the border, with lit tissue on either side and before its
tip. The gap may run to the border as well, but is dark before it, and a border that does not show gives
nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.scope_rotation.notch_border import STEP, STEPS, Border, find_border

MIN_DEPTH = 0.012  # of the radius
MAX_DEPTH = 0.16
WIDTHS = (np.radians(1.0), np.radians(14.0))  # at a third of the depth
FLANK = 0.6  # of the width, on either side, that must show the border itself
FLAT = 0.3  # of the depth, within which the flanks lie about the border
SEEN_FLANK = 0.8  # of the flanks' directions
SOLID = 0.95  # of the directions of notch and flanks, lit all the way inside
ALIKE = (0.65, 1.45)  # of the known shape's depth and width
NOTCH_SIGMA = np.radians(0.1)  # of an angle found: it was below 0.05 deg on rendered pictures, real notches
# are blunter
MIN_LEAD = 2.0  # times the area of the next candidate, where the shape is not known
FOOT = 1.0 / 3.0  # of the depth, at which the width is measured


class Notch(NamedTuple):
    """`angle` [rad] of the notch about the centre of the field, from the image's x to its y, in (-pi, pi].

    `depth` is how far it reaches into the field, in its radii; negative where it reaches out of it. `width`
    [rad] is that at a third of the depth.
    """

    angle: float
    depth: float
    width: float


class NotchShape(NamedTuple):
    """`depth` and `width` of the notch of one scope, as in `Notch`."""

    depth: float
    width: float

    def fits(self, notch: Notch) -> bool:
        """Whether a notch is of this shape."""
        pairs = ((notch.depth, self.depth), (notch.width, self.width))
        return all(ALIKE[0] <= found / known <= ALIKE[1] for found, known in pairs)


def find_notch(image: npt.NDArray[np.uint8], field: FieldOfView) -> Notch | None:
    """The notch of an image (h, w, 3); None where the border shows none, or several that look alike."""
    found = notches(image, field)
    if not found:
        return None
    areas = sorted((abs(notch.depth) * notch.width for notch in found), reverse=True)
    if len(areas) > 1 and areas[0] < MIN_LEAD * areas[1]:
        return None
    return max(found, key=lambda notch: abs(notch.depth) * notch.width)


def notches(image: npt.NDArray[np.uint8], field: FieldOfView, shape: NotchShape | None = None) -> list[Notch]:
    """All that looks like a notch in an image (h, w, 3), or like one of a known shape."""
    border = find_border(image, field)
    if border is None:
        return []
    return notches_of(border, shape)


def notches_of(border: Border, shape: NotchShape | None = None) -> list[Notch]:
    """As `notches`, of a border."""
    found = []
    for side in (1.0, -1.0):
        if shape is not None and side * shape.depth < 0:
            continue
        depth = np.nan_to_num(side * border.depth, nan=0.0)
        least = MIN_DEPTH if shape is None else FOOT * abs(shape.depth)
        for run in _runs(depth > least):
            notch = _notch(border, side, run)
            if notch is None and shape is None:
                notch = _notch(border, side, _tip(depth, run))
            if notch is not None and (shape is None or shape.fits(notch)):
                found.append(notch)
    return found


def common_shape(seen: Sequence[Notch | None]) -> NotchShape | None:
    """The median shape of notches seen; None where none was."""
    known = [notch for notch in seen if notch is not None]
    if not known:
        return None
    return NotchShape(
        *(float(np.median([getattr(one, name) for one in known])) for name in ("depth", "width"))
    )


def _notch(border: Border, side: float, run: npt.NDArray[np.intp]) -> Notch | None:
    """The notch whose border leaves the circle in a run of directions; None if it is not a notch."""
    depths = border.depth
    depth = side * depths[run]
    peak = float(depth.max())
    # Of a tip that is one direction wide the neighbours give its depth.
    if not MIN_DEPTH <= peak <= MAX_DEPTH:
        return None
    width = _width(side * depths, int(run[int(depth.argmax())]), FOOT * peak)
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        return None
    if not _stands_alone(border, run, width, peak):
        return None
    reach = np.arange(run[0] - 2, run[0] + len(run) + 2) % STEPS
    weight = np.maximum(np.nan_to_num(side * depths[reach]), 0.0)
    angle = float(weight @ np.arange(len(reach))) / float(weight.sum()) + float(reach[0])
    angle = (angle * STEP + np.pi) % (2 * np.pi) - np.pi
    return Notch(angle, side * peak, width)


def _tip(depth: Array, run: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """The part of a run about its deepest direction that is above the foot.

    A border that lies a little beside its circle makes one run of a notch and what is beside it.
    """
    high = depth[run] > FOOT * float(depth[run].max())
    middle = int(depth[run].argmax())
    low_before, low_behind = np.flatnonzero(~high[:middle]), np.flatnonzero(~high[middle:])
    begin = int(low_before[-1]) + 1 if len(low_before) else 0
    end = middle + int(low_behind[0]) if len(low_behind) else len(run)
    return run[begin:end]


def _width(depth: Array, tip: int, level: float) -> float:
    """Width [rad] about a direction at a level, between the directions; 0 where an end does not show."""
    total = 0.0
    for way in (1, -1):
        for step in range(1, STEPS // 8):
            here, before = depth[(tip + way * step) % STEPS], depth[(tip + way * (step - 1)) % STEPS]
            if not np.isfinite(here):
                return 0.0
            if here < level:
                total += step - 1 + float((before - level) / max(before - here, 1e-9))
                break
        else:
            return 0.0
    return total * STEP


def _stands_alone(border: Border, run: npt.NDArray[np.intp], width: float, peak: float) -> bool:
    """Whether the border itself shows on either side of a run, and all is lit inside: no gap runs past."""
    # The foot of a notch is wider than where it was cut.
    foot, length = round(0.3 * width / STEP) + 1, max(3, round(FLANK * width / STEP))
    for begin in (run[-1] + 1 + foot, run[0] - foot - length):
        flank = border.depth[np.arange(begin, begin + length) % STEPS]
        with np.errstate(invalid="ignore"):
            if (np.abs(flank) < FLAT * peak).mean() < SEEN_FLANK:
                return False
    around = np.arange(run[0] - foot - length, run[0] + len(run) + foot + length) % STEPS
    return bool(border.solid[around].mean() >= SOLID)


def _runs(over: npt.NDArray[np.bool_]) -> list[npt.NDArray[np.intp]]:
    """Runs of directions, around the circle, in which something holds."""
    if over.all() or not over.any():
        return []
    start = int(np.flatnonzero(~over)[0])
    order = (np.arange(STEPS) + start) % STEPS
    edges = np.diff(np.concatenate([[0], over[order].astype(int), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [order[begin:end] for begin, end in zip(begins, ends, strict=True)]
