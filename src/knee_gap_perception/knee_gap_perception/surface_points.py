"""Where on the tissue beside an edge a point is best followed."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_perception.field_of_view import FieldOfView
from knee_gap_perception.patch_registration import Patch, surface_around
from knee_gap_perception.section import Section

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

EDGE_SEARCH = 14  # [px] within which the edge of the section is refined in the full image
ALONG = (-48, -36, -24, -12, 0, 12, 24, 36, 48)  # [px] along the edge from the section
INSETS = (0.75, 1.0, 1.25)  # of the inset that is asked for
PATCH_HALF = 24  # [px] half side of the piece of tissue that is judged
MINIMUM_TISSUE = 0.5  # share of that piece that must be tissue without highlight


@dataclass(frozen=True)
class SurfacePoint:
    """A point on the tissue: pixel (2,), and how well its texture fixes it (the weaker direction's information)."""

    pixel: Array
    texture: float


def choose_points(
    grey: Image, section: Section, field: FieldOfView, inset_px: float
) -> list[SurfacePoint] | None:
    """The two points beside a section's edges, `inset_px` inside the tissue; None where a side has none.

    Near the section, and a little nearer to or farther from the edge, the place with the strongest texture and
    without highlight is taken: the texture is what the point is followed by.
    """
    chosen = []
    for index, sign in enumerate((-1.0, 1.0)):
        outward = sign * section.across
        along = np.array([-outward[1], outward[0]])
        threshold = 0.5 * (section.levels[0] + section.levels[1 + index])
        best: SurfacePoint | None = None
        for shift in ALONG:
            edge = _edge_on_line(grey, section.edges[index] + shift * along, outward, threshold, abs(shift))
            if edge is None:
                continue
            for share in INSETS:
                point = _judge(grey, edge + share * inset_px * outward, threshold, shift)
                if field.depth_inside(point.pixel) > 2 * PATCH_HALF and (
                    best is None or point.texture > best.texture
                ):
                    best = point
        if best is None or best.texture <= 0:
            return None
        chosen.append(best)
    return chosen


def _edge_on_line(grey: Image, start: Array, outward: Array, threshold: float, slack: float) -> Array | None:
    """First pixel (2,), to half a pixel, at which brightness rises over the threshold along a line to the tissue."""
    steps = np.arange(-EDGE_SEARCH - slack, EDGE_SEARCH + slack, 0.5)
    points = np.rint(start + steps[:, None] * outward).astype(int)
    inside = (points >= 0).all(axis=1) & (points < [grey.shape[1], grey.shape[0]]).all(axis=1)
    if not inside.all():
        return None
    lit = grey[points[:, 1], points[:, 0]] > threshold
    # The last dark pixel before steady tissue: specks in the gap are not its edge.
    dark = np.flatnonzero(~lit)
    if not dark.size or dark[-1] + 1 >= lit.size - 4:
        return None
    return np.asarray(start + steps[dark[-1] + 1] * outward)


def _judge(grey: Image, pixel: Array, dark_below: float, shift: float) -> SurfacePoint:
    surface = surface_around(grey, pixel, PATCH_HALF + 10, dark_below)
    patch = Patch(surface, pixel, PATCH_HALF)
    if patch.weight.sum() < MINIMUM_TISSUE * patch.window_sum * 0.5:
        return SurfacePoint(pixel, 0.0)
    weaker = float(np.linalg.eigvalsh(patch.information())[0])
    # Away from the section the distance of the points is no longer that of the edges.
    return SurfacePoint(pixel, weaker * (1.0 - (shift / 120.0) ** 2))
