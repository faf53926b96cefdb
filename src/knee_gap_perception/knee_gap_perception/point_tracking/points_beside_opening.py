"""Points beside an opening that a network drew: its borders are the edges, whatever lies behind them.

`point_selection` finds edges as steps of brightness in pictures of a usual size. Here a wall may be as bright
as the tissue before it, the opening may lie near the rim, and a small picture is enlarged.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeKind
from knee_gap_perception.gap_detection.cross_section import Section
from knee_gap_perception.gap_detection.edge_classifier import edge_kind
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.point_tracking.point_selection import SurfacePoint
from knee_gap_perception.point_tracking.texture import TissueTexture

USUAL_EXTENT = 330.0  # [px] radius of the field for which lengths and patches are made
MOST_ENLARGED = 3.0
SEARCH = 32  # [px] around the section's edge, within which the border is found
ALONG = (-40, -32, -24, -16, -8, 0, 8, 16, 24, 32, 40)  # [px] along the edge from the section
FARTHEST = 64.0  # [px] along the edge, where the texture would count nothing
INSETS = (0.75, 1.0, 1.3)  # of the inset that is asked for
PATCH_HALF = 24  # [px] half side of the piece of tissue that is judged
LEAST_TISSUE = 0.3  # share of that piece that must be tissue without highlight
NEAR_RIM = 10.0  # [px] from the rim of the field that a point must keep
AWAY = 8  # [px at working size] from instruments
AWAY_FROM_GLARE = 4  # [px at working size]
MOST_OF_A_BLOCK = 1.5  # as for `point_selection`
DARK_SHARE = 0.35  # of the way from opening to tissue, below which a pixel is the opening
LIT = 0.6  # of the tissue's brightness, from which a wall counts as lit
LIT_DARK = 0.25  # of the tissue's brightness, below which a pixel is no tissue where the wall is lit


def points_beside_opening(
    grey: Image,
    section: Section,
    field: FieldOfView,
    inset_px: float,
    masks: tuple[Mask, Mask, Mask],
    scale: float,
) -> list[SurfacePoint] | None:
    """The two points beside a section's edges, `inset_px` inside the tissue; None where a side has none.

    `masks` (h, w) are the opening, instruments and glare in the picture made smaller by `scale`.
    """
    opening, instruments, glare = masks
    near = _grown(instruments, AWAY) | _grown(glare, AWAY_FROM_GLARE) | opening
    larger = float(np.clip(USUAL_EXTENT / max(field.extent, 1.0), 1.0, MOST_ENLARGED))
    shown = grey
    if larger > 1.0:
        shown = np.asarray(
            cv2.resize(grey, None, fx=larger, fy=larger, interpolation=cv2.INTER_CUBIC), np.uint8
        )
    chosen = []
    for index, sign in enumerate((-1.0, 1.0)):
        outward = sign * section.across
        best: SurfacePoint | None = None
        for shift, edge, pixel in _places(section.edges[index], outward, inset_px, larger, opening, scale):
            if field.depth_inside(pixel) * larger <= NEAR_RIM or not _is_clear(pixel, near, scale):
                continue
            point = _judged(shown, section.centre, edge, pixel, outward, larger)
            point = replace(point, texture=point.texture * (1.0 - (shift / FARTHEST) ** 2))
            if point.texture > 0 and (best is None or _merit(point) > _merit(best)):
                best = point
        if best is None:
            return None
        chosen.append(best)
    return chosen


def _merit(point: SurfacePoint) -> tuple[bool, float]:
    return point.kind is not EdgeKind.SHADING, point.texture


def _places(
    at: Array, outward: Array, inset_px: float, larger: float, opening: Mask, scale: float
) -> Iterator[tuple[float, Array, Array]]:
    """Shift along the edge [px, enlarged], border (2,), and place inside the tissue (2,)."""
    along = np.array([-outward[1], outward[0]])
    reach = SEARCH / larger + inset_px
    for shift in ALONG:
        edge = _border(opening, at + shift / larger * along, outward, reach, scale)
        if edge is not None:
            for share in INSETS:
                yield shift, edge, edge + share * inset_px * outward


def _border(opening: Mask, start: Array, outward: Array, reach: float, scale: float) -> Array | None:
    """Where a line (2,) to the tissue leaves an opening (h, w) at working size, to half a pixel."""
    steps = np.arange(-reach, reach, 0.5)
    column, row = np.rint((start + steps[:, None] * outward + 0.5) * scale - 0.5).astype(int).T
    shown = (row >= 0) & (column >= 0) & (row < opening.shape[0]) & (column < opening.shape[1])
    inside = np.zeros(steps.shape, bool)
    inside[shown] = opening[row[shown], column[shown]]
    last = np.flatnonzero(inside)
    if not last.size or last[-1] + 1 >= steps.size - 4:
        return None
    return np.asarray(start + steps[last[-1] + 1] * outward)


def _judged(
    shown: Image, centre: Array, edge: Array, pixel: Array, outward: Array, larger: float
) -> SurfacePoint:
    """A place with the texture there, in a picture (h, w) enlarged from that of the places."""
    gap, tissue = (_level(shown, _enlarged(place, larger)) for place in (centre, pixel))
    dark_below = gap + DARK_SHARE * (tissue - gap) if gap < LIT * tissue else LIT_DARK * tissue
    place = _enlarged(pixel, larger)
    information, share = TissueTexture(shown, place, 1.0, PATCH_HALF, dark_below).information(
        place, MOST_OF_A_BLOCK
    )
    texture = float(np.linalg.eigvalsh(information)[0]) if share >= LEAST_TISSUE else 0.0
    kind = edge_kind(shown, _enlarged(edge, larger), outward)
    return SurfacePoint(pixel, dark_below, texture, kind, outward)


def _enlarged(pixel: Array, larger: float) -> Array:
    return np.asarray((pixel + 0.5) * larger - 0.5)


def _level(grey: Image, pixel: Array) -> float:
    """Median brightness around a pixel (2,)."""
    column, row = np.rint(pixel).astype(int)
    patch = grey[max(0, row - 6) : max(0, row + 7), max(0, column - 6) : max(0, column + 7)]
    return float(np.median(patch)) if patch.size else 0.0


def _grown(mask: Mask, margin: int) -> Mask:
    side = 2 * margin + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _is_clear(pixel: Array, near: Mask, scale: float) -> bool:
    column, row = np.rint((pixel + 0.5) * scale - 0.5).astype(int)
    return not near[min(max(row, 0), near.shape[0] - 1), min(max(column, 0), near.shape[1] - 1)]
