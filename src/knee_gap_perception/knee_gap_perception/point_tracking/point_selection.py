"""Where on the tissue beside an edge a point is best followed."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeKind
from knee_gap_perception.gap_detection.cross_section import Section
from knee_gap_perception.gap_detection.edge_classifier import edge_kind
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.point_tracking.texture import TissueTexture

EDGE_SEARCH = 32  # [px] within which the edge of the section is refined in the full image
ALONG = (-48, -36, -24, -12, 0, 12, 24, 36, 48)  # [px] along the edge from the section
INSETS = (0.75, 1.0, 1.25)  # of the inset that is asked for
PATCH_HALF = 24  # [px] half side of the piece of tissue that is judged
MINIMUM_TISSUE = 0.4  # share of that piece that must be tissue without highlight
AWAY = 12  # [px at working size] from instruments: half of what a point is followed by
AWAY_FROM_GLARE = 6  # [px at working size]: glare is left out of what is followed, but moves with the lamp
MOST_OF_A_BLOCK = (
    1.5  # of the median block's texture that one block counts: drifting debris is texture as well
)
DARK_SHARE = 0.35  # of the way from gap to tissue, below which a pixel is the gap


@dataclass(frozen=True)
class SurfacePoint:
    """A point on the tissue beside the gap.

    `pixel` (2,); `dark_below`, the grey level below which is the gap; `texture`, the information on a shift
    in the weaker direction [1/px^2]; `kind` of the edge; `outward`, the unit vector (2,) from the gap onto
    the tissue.
    """

    pixel: Array
    dark_below: float
    texture: float
    kind: EdgeKind
    outward: Array


class _Place(NamedTuple):
    """A pixel (2,) beside an edge of a kind, `shift` [px] along it from the section."""

    pixel: Array
    shift: int
    kind: EdgeKind


def choose_points(
    grey: Image,
    section: Section,
    field: FieldOfView,
    inset_px: float,
    foreign: Mask,
    scale: float,
    instruments: Mask | None = None,
) -> list[SurfacePoint] | None:
    """The two points beside a section's edges, `inset_px` inside the tissue; None where a side has none.

    Near the section, and a little nearer to or farther from the edge, the place with the strongest texture
    and without highlight is taken: the texture is what the point is followed by. `foreign` (h, w) is where
    the picture, made smaller by `scale`, shows what is no tissue, and `instruments` (h, w) the part of it
    that is not glare (all of it if not given); no place beside them is taken.
    """
    near = _grown(foreign if instruments is None else instruments, AWAY) | _grown(foreign, AWAY_FROM_GLARE)
    gap = _level(grey, section.centre)
    chosen = []
    for index, sign in enumerate((-1.0, 1.0)):
        outward = sign * section.across
        along = np.array([-outward[1], outward[0]])
        # Shaded bone behind a rim may pass for tissue: the edge may lie as far as tissue was measured.
        reach = EDGE_SEARCH + inset_px
        tissue = _level(grey, section.edges[index] + reach * outward)
        if tissue <= gap:
            return None
        dark_below = gap + DARK_SHARE * (tissue - gap)
        places = []
        for shift in ALONG:
            start = section.edges[index] + shift * along
            edge = _edge_on_line(grey, start, outward, reach, (gap + tissue) / 2)
            if edge is not None:
                insets = edge + np.outer(INSETS, inset_px * outward)
                deep = field.depth_inside(insets) > 2 * PATCH_HALF
                usable = [pixel for pixel in insets[deep] if _is_clear(pixel, near, scale)]
                if usable:
                    kind = edge_kind(grey, edge, outward)
                    places += [_Place(pixel, shift, kind) for pixel in usable]
        if not places:
            return None
        candidates = _judged(grey, places, dark_below, outward)
        # Where no surface ends, what looks like the texture of one may be that of another behind it.
        best = max(candidates, key=lambda point: (point.kind is not EdgeKind.SHADING, point.texture))
        if best.texture <= 0:
            return None
        chosen.append(best)
    return chosen


def _grown(mask: Mask, margin: int) -> Mask:
    """A mask (h, w) with a margin [px] around it."""
    side = 2 * margin + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _is_clear(pixel: Array, near: Mask, scale: float) -> bool:
    """Whether a pixel (2,) lies apart from what is no tissue: a probe has more texture than any tissue."""
    column, row = np.rint(scale * pixel).astype(int)
    return not near[min(row, near.shape[0] - 1), min(column, near.shape[1] - 1)]


def _level(grey: Image, pixel: Array) -> float:
    """Median brightness around a pixel (2,)."""
    column, row = np.rint(pixel).astype(int)
    patch = grey[max(0, row - 6) : max(0, row + 7), max(0, column - 6) : max(0, column + 7)]
    return float(np.median(patch)) if patch.size else 0.0


def _edge_on_line(grey: Image, start: Array, outward: Array, reach: float, threshold: float) -> Array | None:
    """Where brightness rises over the threshold along a line to the tissue (2,), to half a pixel.

    The line ends `reach` [px] beyond its start.
    """
    steps = np.arange(-EDGE_SEARCH, reach, 0.5)
    points = np.rint(start + steps[:, None] * outward).astype(int)
    inside = (points >= 0).all(axis=1) & (points < [grey.shape[1], grey.shape[0]]).all(axis=1)
    if not inside.all():
        return None
    # The last dark pixel before steady tissue: specks in the gap are not its edge.
    dark = np.flatnonzero(grey[points[:, 1], points[:, 0]] <= threshold)
    if not dark.size or dark[-1] + 1 >= steps.size - 4:
        return None
    return np.asarray(start + steps[dark[-1] + 1] * outward)


def _judged(grey: Image, places: list[_Place], dark_below: float, outward: Array) -> list[SurfacePoint]:
    """The places with the texture there."""
    pixels = np.stack([place.pixel for place in places])
    centre = (pixels.min(axis=0) + pixels.max(axis=0)) / 2
    reach = float(np.abs(pixels - centre).max()) + 1.0
    tissue = TissueTexture(grey, centre, reach, PATCH_HALF, dark_below)
    points = []
    for place in places:
        information, share = tissue.information(place.pixel, MOST_OF_A_BLOCK)
        texture = 0.0
        if share >= MINIMUM_TISSUE:
            # Away from the section the distance of the points is no longer that of the edges.
            texture = float(np.linalg.eigvalsh(information)[0]) * (1.0 - (place.shift / 120.0) ** 2)
        points.append(SurfacePoint(place.pixel, dark_below, texture, place.kind, outward))
    return points
