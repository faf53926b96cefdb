"""Selection of the point on the tissue beside an edge that is best followed."""

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
# The lengths in pixels are those of a picture of 720 rows; in a smaller field they are the same shares of it.
USUAL_EXTENT = 240.0  # [px] radius of the field below which they shrink
LEAST_UNIT = 0.3  # [-] of the lengths, in the smallest fields
DEEP = 2.0  # half sides of a patch by which a place should lie inside the field, so that it stays in view
NEAR_RIM = 0.75  # the same, where an opening near the rim leaves no such place
LEVEL_HALF = 6  # [px] half side of the square of which brightness is the median
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
    """A pixel (2,) beside an edge of a kind.

    `shift` is its place along the edge, counted from the section; `deep`: it lies well inside the field.
    """

    pixel: Array
    shift: int
    kind: EdgeKind
    deep: bool


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
    and without highlight is taken: the texture is what the point is followed by. Places near the rim of the
    field soon leave it: they are taken only where there are no others. `foreign` (h, w) is where
    the picture, made smaller by `scale`, shows what is not tissue, and `instruments` (h, w) the part of it
    that is not glare (all of it if not given); no place beside them is taken.
    """
    near = _grown(foreign if instruments is None else instruments, AWAY) | _grown(foreign, AWAY_FROM_GLARE)
    gap = _level(grey, section.centre)
    unit = float(np.clip(field.extent / USUAL_EXTENT, LEAST_UNIT, 1.0))
    patch_half = round(unit * PATCH_HALF)
    chosen = []
    for index, sign in enumerate((-1.0, 1.0)):
        outward = sign * section.across
        along = np.array([-outward[1], outward[0]])
        # Shaded bone behind a rim may pass for tissue: the edge may lie as far as tissue was measured.
        search = unit * EDGE_SEARCH
        reach = _inside(field, section.edges[index], outward, search + inset_px)
        tissue = _level(grey, section.edges[index] + reach * outward)
        if tissue <= gap:
            return None
        dark_below = gap + DARK_SHARE * (tissue - gap)
        places = []
        for shift in ALONG:
            start = section.edges[index] + unit * shift * along
            edge = _edge_on_line(grey, start, outward, (-search, reach), (gap + tissue) / 2)
            if edge is not None:
                insets = edge + np.outer(INSETS, inset_px * outward)
                depths = field.depth_inside(insets) / patch_half
                usable = [
                    (pixel, depth > DEEP)
                    for pixel, depth in zip(insets, depths, strict=True)
                    if depth > NEAR_RIM and _is_clear(pixel, near, scale)
                ]
                if usable:
                    kind = edge_kind(grey, edge, outward)
                    places += [_Place(pixel, shift, kind, deep) for pixel, deep in usable]
        if not places:
            return None
        if any(place.deep for place in places):
            places = [place for place in places if place.deep]
        candidates = _judged(grey, places, dark_below, outward, patch_half)
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
    """Whether a pixel (2,) lies apart from what is not tissue: a probe has more texture than any tissue."""
    column, row = np.rint(scale * pixel).astype(int)
    return not near[min(row, near.shape[0] - 1), min(column, near.shape[1] - 1)]


def _level(grey: Image, pixel: Array) -> float:
    """Median brightness around a pixel (2,)."""
    column, row = np.rint(pixel).astype(int)
    first, last = -LEVEL_HALF, LEVEL_HALF + 1
    patch = grey[max(0, row + first) : max(0, row + last), max(0, column + first) : max(0, column + last)]
    return float(np.median(patch)) if patch.size else 0.0


def _inside(field: FieldOfView, start: Array, outward: Array, reach: float) -> float:
    """How far [px] a line (2,) from a start (2,) stays well inside the field, at most `reach`."""
    steps = np.arange(0.0, reach, 1.0)
    deep = field.depth_inside(start + steps[:, None] * outward) > LEVEL_HALF
    return reach if deep.all() and steps.size else float(steps[np.argmin(deep)])


def _edge_on_line(
    grey: Image, start: Array, outward: Array, ends: tuple[float, float], threshold: float
) -> Array | None:
    """Where brightness rises over the threshold along a line to the tissue (2,), to half a pixel.

    `ends` [px] are those of the line, from its start.
    """
    steps = np.arange(*ends, 0.5)
    points = np.rint(start + steps[:, None] * outward).astype(int)
    inside = (points >= 0).all(axis=1) & (points < [grey.shape[1], grey.shape[0]]).all(axis=1)
    if not inside.all():
        return None
    # The last dark pixel before steady tissue: specks in the gap are not its edge.
    dark = np.flatnonzero(grey[points[:, 1], points[:, 0]] <= threshold)
    if not dark.size or dark[-1] + 1 >= steps.size - 4:
        return None
    return np.asarray(start + steps[dark[-1] + 1] * outward)


def _judged(
    grey: Image, places: list[_Place], dark_below: float, outward: Array, patch_half: int
) -> list[SurfacePoint]:
    """The places with the texture there, in patches of a half side [px]."""
    pixels = np.stack([place.pixel for place in places])
    centre = (pixels.min(axis=0) + pixels.max(axis=0)) / 2
    reach = float(np.abs(pixels - centre).max()) + 1.0
    tissue = TissueTexture(grey, centre, reach, patch_half, dark_below)
    points = []
    for place in places:
        information, share = tissue.information(place.pixel, MOST_OF_A_BLOCK)
        texture = 0.0
        if share >= MINIMUM_TISSUE:
            # Away from the section the distance of the points is no longer that of the edges.
            texture = float(np.linalg.eigvalsh(information)[0]) * (1.0 - (place.shift / 120.0) ** 2)
        points.append(SurfacePoint(place.pixel, dark_below, texture, place.kind, outward))
    return points
