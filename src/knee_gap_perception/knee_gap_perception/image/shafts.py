"""Detection of instruments by their shape: straight shafts that enter from the rim.

Steel mirrors the tissue around it and black instruments are as dark as a gap, so neither brightness nor
colour distinguishes them. Their edges do: two straight lines, close to parallel, that reach the rim of the
field, with the same look all along between them.
"""

from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.image.field_of_view import FieldOfView

# Lengths are relative to the field's radius.
SHORTEST_PIECE = 0.08  # of an edge
SHORTEST_START = 0.2  # of the piece from which an edge is continued
SHORTEST_EDGE = 0.3  # sum of its pieces
SHORTEST_SHAFT = 0.5
NARROWEST, WIDEST = 0.03, 0.4
MOST_FROM_RIM = 0.12
RIM = 0.92  # beyond which the middle of a piece is the rim of the field
MOST_EDGES = 12  # the longest ones
REDUCTION = 0.6  # of the working size, at which segments are found
OFF_LINE = 1.6  # [px at working size] by which pieces of an edge deviate from a line
MOST_TAPER = np.radians(12.0)
MOST_UNEVEN = 0.05  # [-] variation along the shaft, relative to its brightness
LEVEL_OFFSET = 8.0  # [grey levels]: so that noise of a black shaft does not count
ACROSS = np.array([0.2, 0.35, 0.5, 0.65, 0.8])  # of the width, where brightness along the shaft is sampled
LEAST_STEP = 0.12  # [-] in brightness at either edge, relative to the brighter side
SAMPLES = 32  # along the shaft
BESIDE = 2.0  # [px at working size] to either side of the edges, where the step is sampled
# A straight-sided band that is darker than both sides may be a gap. Light from tissue to tissue makes a gap
# warmer than the tissue; a black instrument has no colour.
DARK_BAND = 0.65  # [-] brightness relative to both sides, below which a band may be a gap
BLACK = 7.0  # [grey levels] up to which a band has no colour
MARGIN = 2  # [px at working size] of the blurred border around a shaft


class _Edge(NamedTuple):
    """A straight edge: `middle` (2,) and direction `along` (2,), from `first` to `last` along it [px]."""

    middle: Array
    along: Array
    first: float
    last: float
    length: float


def find_shafts(image: Image, value: Image, field: FieldOfView, scale: float, warmth: float) -> Mask:
    """Pixels (h, w) of an image (h, w, 3), `scale` times the full size, that show shafts.

    `value` (h, w) is its brightness, `warmth` the least of tissue (`least_warmth`).
    """
    found = np.zeros(value.shape, np.uint8)
    centre, radius = (np.array(field.centre) + 0.5) * scale - 0.5, field.extent * scale
    edges = _edges(value, centre, radius)
    for index, edge in enumerate(edges):
        for other in edges[index + 1 :]:
            band = _band(edge, other, radius)
            if band is not None and _is_shaft(band[0], image, value, centre, radius, warmth):
                cv2.fillConvexPoly(found, np.rint(band[1]).astype(np.int32), (1,))
    if found.any():
        found = np.asarray(cv2.dilate(found, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)))
    return found > 0


def _edges(value: Image, centre: Array, radius: float) -> list[_Edge]:
    """The longest straight edges inside the field."""
    first = np.clip(np.floor(centre - radius), 0, None).astype(int)
    last = np.ceil(centre + radius).astype(int) + 1
    part = np.ascontiguousarray(value[first[1] : last[1], first[0] : last[0]])
    # None if there is no segment.
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE, REDUCTION)
    segments = np.array(detector.detect(part)[0], dtype=np.float64, ndmin=1)
    if np.isnan(segments).any():
        return []
    ends = segments.reshape(-1, 2, 2) + first
    steps = ends[:, 1] - ends[:, 0]
    length = np.hypot(steps[:, 0], steps[:, 1])
    # The rim itself is not an edge.
    away = np.hypot(*(ends.mean(axis=1) - centre).T)
    kept = (length > SHORTEST_PIECE * radius) & (away < RIM * radius)
    ends, length, along = ends[kept], length[kept], steps[kept] / length[kept, None]
    starts = np.argsort(-length, kind="stable")[: (length >= SHORTEST_START * radius).sum()]
    normals = np.stack([-along[starts, 1], along[starts, 0]])
    # How far either end of each piece (n, 2) lies from the line through each start (starts).
    off = np.abs(ends @ normals - (ends[starts, 0] * normals.T).sum(axis=1)).max(axis=1)
    places = ends @ along[starts].T
    on_line = off < OFF_LINE
    free = np.ones(len(length), bool)
    edges: list[_Edge] = []
    for index, start in enumerate(starts):
        pieces = free & on_line[:, index]
        if free[start] and length[pieces].sum() > SHORTEST_EDGE * radius:
            reach = places[pieces, :, index]
            if reach.max() - reach.min() > SHORTEST_SHAFT * radius:
                free &= ~pieces
                edges.append(_line_through(ends[pieces], length[pieces], along[start]))
    return edges[:MOST_EDGES]


def _line_through(ends: Array, length: Array, along: Array) -> _Edge:
    """The edge through the ends (n, 2, 2) of pieces of some length (n,), roughly in a direction (2,)."""
    weight = length / length.sum()
    middle = weight @ ends.mean(axis=1)
    places = ends - middle
    across, down = places[..., 0], places[..., 1]
    # The principal axis of the points.
    angle = 0.5 * np.arctan2(
        2.0 * (weight @ (across * down).sum(axis=1)), weight @ (across**2 - down**2).sum(axis=1)
    )
    line = np.array([np.cos(angle), np.sin(angle)])
    line *= 1.0 if line @ along > 0.0 else -1.0
    places = places @ line
    return _Edge(middle, line, float(places.min()), float(places.max()), float(length.sum()))


def _band(edge: _Edge, other: _Edge, radius: float) -> tuple[Array, Array] | None:
    """The band between two edges where they overlap, and where either is seen; None if no shaft's.

    Each is its corners (4, 2): two on the first edge, and two, in reverse order, on the other.
    """
    if abs(edge.along @ other.along) < np.cos(MOST_TAPER):
        return None
    normal = np.array([-edge.along[1], edge.along[0]])
    ends = other.middle + np.array([[other.first], [other.last]]) * other.along - edge.middle
    place, offset = ends @ edge.along, ends @ normal
    if place[0] > place[1]:
        place, offset = place[::-1], offset[::-1]
    overlap = np.array([max(edge.first, place[0]), min(edge.last, place[1])])
    length = overlap[1] - overlap[0]
    if length < SHORTEST_SHAFT * radius:
        return None
    slope = (offset[1] - offset[0]) / (place[1] - place[0])
    width = offset[0] + slope * (overlap - place[0])
    mean = float(np.abs(width).mean())
    if width[0] * width[1] <= 0 or not max(NARROWEST * radius, 2.0) < mean < min(WIDEST * radius, length):
        return None
    bands = []
    for extent in (overlap, np.array([min(edge.first, place[0]), max(edge.last, place[1])])):
        near = edge.middle + extent[:, None] * edge.along
        far = near + (offset[0] + slope * (extent - place[0]))[:, None] * normal
        bands.append(np.concatenate([near, far[::-1]]))
    return bands[0], bands[1]


def _is_shaft(
    corners: Array, image: Image, value: Image, centre: Array, radius: float, warmth: float
) -> bool:
    """Whether a band with corners (4, 2) looks like an instrument."""
    starts = corners[[0, 3]]
    axis = np.stack([starts.mean(axis=0), corners[[1, 2]].mean(axis=0)])
    if np.hypot(*(axis - centre).T).max() < (1.0 - MOST_FROM_RIM) * radius:
        return False
    # Lines along the band, then two inside and two outside its edges.
    across = starts[1] - starts[0]
    width = float(np.linalg.norm(across))
    beside = np.outer([-1.0, 1.0], across / width)
    share = ACROSS[:, None]
    into = min(BESIDE, 0.3 * width)
    first, last = (
        np.concatenate([(1 - share) * end[0] + share * end[1], end - into * beside, end + BESIDE * beside])
        for end in (starts, corners[[1, 2]])
    )
    step = np.linspace(0.02, 0.98, SAMPLES)[:, None]
    places = (first[:, None] + step * (last - first)[:, None]).astype(np.float32)
    lines = cv2.remap(value, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    inside, beside_edges = lines[:-4], np.median(lines[-4:], axis=1).reshape(2, 2)
    steps = np.abs(np.diff(beside_edges, axis=0)[0]) / np.maximum(beside_edges.max(axis=0), 1.0)
    if steps.min() < LEAST_STEP:
        return False
    # Brightness may rise or fall evenly along a shaft.
    ramp = step[:, 0] - step.mean()
    ramp /= np.linalg.norm(ramp)
    rest = inside - inside.mean(axis=1, keepdims=True)
    rest -= np.outer(rest @ ramp, ramp)
    if np.median(rest.std(axis=1)) > MOST_UNEVEN * (inside.mean() + LEVEL_OFFSET):
        return False
    if np.median(inside) > DARK_BAND * beside_edges[1].min():
        return True
    colour = cv2.remap(image, places[:-4, :, 0], places[:-4, :, 1], cv2.INTER_LINEAR)
    blue, green, red = np.median(colour.reshape(-1, 3), axis=0)
    brightest = float(max(blue, green, red))
    return bool(brightest > BLACK and red - blue < warmth * brightest)
