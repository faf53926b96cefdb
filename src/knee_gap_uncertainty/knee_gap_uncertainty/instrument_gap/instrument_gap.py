"""The instrument gap: how thick a straight instrument passes between the two edges of the opening.

In the plane of the section the lens sees the edges at angles -h and +h from the middle of the opening. A line
of sight along an edge touches the tissue there and is free before it. An instrument whose axis is tilted by t
against the view comes, on the side of edge k, as far out as

    S = (r + D) sin(q) - R (1 - cos(q)),    q = h + t on side 0, h - t on side 1,

where r is the distance of the tracked point beside the edge, D how much farther the edge lies than it, and R
the radius of the surface that bulges behind the edge. The gap is S_0 + S_1 at the best tilt within CONE.

The point lies w = r sin(inset) beside the line of sight along its edge. A smooth bone of radius R that
touches that line leaves it by w over the distance D = sqrt(2 R w); a rim is the end of a flat face at a
slope, D = w / tan(slope), and has no radius. Which of the shapes that its kind of edge admits the tissue has
is not known: the estimate is their mean, their deviation is part of the interval, and their extremes are
part of the bounds.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeKind
from knee_gap_uncertainty.instrument_gap.gap_kernels import (
    TINY,
    edge_slopes,
    ends_over_ellipse,
    gap_bounds,
    mean_farther,
    mean_side,
    opening_between,
    ranges_under_errors,
    widest,
)
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit

# Half angle of the cone of directions, about the direction of view, from which the instrument may come.
CONE = np.radians(10.0)
TILTS = np.linspace(-CONE, CONE, 21)

# Shapes of the tissue between point and edge: radius [m], 0 for a flat face, and tangent of the face's slope.
CONTOUR_SHAPES = np.array([[radius, 1.0] for radius in (0.008, 0.012, 0.016, 0.020, 0.025, 0.030)])
RIM_SHAPES = np.array([[0.0, np.tan(np.radians(slope))] for slope in (25.0, 35.0, 45.0, 60.0, 80.0)])
ALL_SHAPES = np.concatenate([CONTOUR_SHAPES, RIM_SHAPES])
SHAPES = {EdgeKind.RIM: RIM_SHAPES, EdgeKind.CONTOUR: CONTOUR_SHAPES}

# How far [m] a real surface departs from these shapes: ripples, frayed rims, a point beside the section.
ROUGHNESS = 0.08e-3
ROUGHNESS_BOUND = 0.12e-3

# Angle [rad] by which a point may lie beyond its edge, and ratio of the points' distances. Beyond them it
# is not on the tissue that ends at its edge, but on something before or behind it.
MOST_INSET = 0.2
# Distance [m] of a point from the line of sight along its edge. The surface between them is one of the shapes
# above only if it is short: beyond this, edges beside the notch of a knee of meshes were far deeper.
MOST_BESIDE = 1.2e-3
MOST_RATIO = 2.5
LEAST_HALF, MOST_HALF = 0.002, np.radians(60.0)  # half angle of an opening [rad]


class Edges(NamedTuple):
    """Both edges in the frame of the points: bearings (2, 3), deviations (2,) and bound of the error [rad].

    `kinds` (2,) are those of the edges. `bounded` is false where an edge lies in the given
    direction or farther out.
    """

    bearings: Array
    deviations: Array
    error: float
    kinds: tuple[EdgeKind, EdgeKind]
    bounded: bool = True

    @property
    def shapes(self) -> tuple[Array, Array]:
        """What is admitted between each point and its edge, (n, 2) each."""
        return admitted_shapes(self.kinds[0]), admitted_shapes(self.kinds[1])


class Opening(NamedTuple):
    """The opening in the plane of the section, as one lens sees it.

    `half` [rad]: half of the angle between the edges; `insets` (2,) [rad]: the angle by which each tracked
    point lies beyond its edge; `in_plane` (2,): the cosine of the angle by which it lies beside that plane.
    `view` and `across` (3,): the direction of view through the middle, and from edge 0 to edge 1 across it.
    """

    half: float
    insets: Array
    in_plane: Array
    view: Array
    across: Array


@dataclass(frozen=True, eq=False)
class InstrumentGap:
    """The instrument gap with its interval [m], the instrument's axis, and what edges and shapes contribute.

    `point` (3,) lies midway between the edges, `axis` (3,) leads away from the lens. `shares` (2,): parts of
    the variance that come from the edges and from the shape.
    """

    gap: float
    lower: float
    upper: float
    point: Array
    axis: Array
    shares: Array


def admitted_shapes(kind: EdgeKind) -> Array:
    """Shapes (n, 2) that the tissue beside an edge of a kind may have."""
    return np.asarray(SHAPES.get(kind, ALL_SHAPES))


def opening_of(points: Array, edges: Array) -> Opening:
    """The opening between edges (2, 3), with tracked points beside them at bearings `points` (2, 3)."""
    return Opening(*opening_between(np.ascontiguousarray(points), np.ascontiguousarray(edges)))


def flaw_of(opening: Opening, ranges: Array, inside: float) -> str:
    """Why edges cannot be used with points at distances (2,) [m], in words; empty if they can.

    `inside` [rad] is the angle by which errors may make a point appear inside the opening.
    """
    if not LEAST_HALF < opening.half < MOST_HALF:
        return "the edges do not enclose an opening"
    if not (opening.insets > -inside).all():
        return "a tracked point lies inside the opening"
    beside = np.where(np.isfinite(ranges), ranges, 0.0) * np.sin(opening.insets)
    if not ((opening.insets < MOST_INSET) & (beside < MOST_BESIDE)).all():
        return "a tracked point lies too far from its edge"
    if np.isfinite(ranges).all() and not ranges.max() < MOST_RATIO * ranges.min():
        return "the two sides of the opening lie at too different distances"
    return ""


def instrument_gap(
    fit: MultiViewFit, lens: Array, opening: Opening, edges: Edges, radius: float
) -> InstrumentGap:
    """The instrument gap of the fitted points with the edges that a lens (3,) [m] sees, and its interval.

    `radius`: two-sided normal deviate of the confidence level. The upper end is infinite where the data do
    not bound it.
    """
    rays = fit.points - lens
    distances = np.linalg.norm(rays, axis=1)
    ranges = distances * opening.in_plane
    gap, tilt, shape_deviation = widest(opening.half, ranges, opening.insets, *edges.shapes, TILTS)
    along = np.zeros((2, 6))
    along[0, :3], along[1, 3:] = rays / distances[:, None] / distances[:, None] ** 2
    inverse_covariance = along @ fit.covariance @ along.T
    lower, upper, variance = ends_over_ellipse(
        ranges,
        inverse_covariance,
        fit.bend.widening * radius,
        opening.half,
        opening.insets,
        *edges.shapes,
        tilt,
    )
    shape_variance = shape_deviation**2 + 2.0 * ROUGHNESS**2
    slopes = edge_slopes(ranges, opening.half, opening.insets, *edges.shapes, tilt)
    edge_variance = float(np.sum((edges.deviations * slopes) ** 2))
    # The points' errors, the edges' and the shape's are independent of each other.
    own = radius**2 * (edge_variance + shape_variance)
    total = variance + edge_variance + shape_variance
    point, axis = _axis(lens, ranges, opening, edges, tilt)
    return InstrumentGap(
        gap=gap,
        lower=max(gap - float(np.sqrt((gap - lower) ** 2 + own)), 0.0),
        upper=gap + float(np.sqrt((upper - gap) ** 2 + own)),
        point=point,
        axis=axis,
        shares=np.array([edge_variance, shape_variance]) / total,
    )


def _axis(lens: Array, ranges: Array, opening: Opening, edges: Edges, tilt: float) -> tuple[Array, Array]:
    """A point (3,) on the axis of the instrument that fits, as deep as the edges, and its direction (3,)."""
    angles = (opening.half + tilt, opening.half - tilt)
    numbers = [(float(ranges[n]), float(opening.insets[n]), edges.shapes[n]) for n in range(2)]
    out = [mean_side(numbers[n][0], angles[n], *numbers[n][1:])[0] for n in range(2)]
    depth = float(np.mean([one[0] + mean_farther(*one) for one in numbers])) * np.cos(opening.half)
    axis = np.cos(tilt) * opening.view + np.sin(tilt) * opening.across
    normal = np.cos(tilt) * opening.across - np.sin(tilt) * opening.view
    return lens + depth * axis + 0.5 * (out[1] - out[0]) * normal, axis


def widest_gap(points: Array, lens: Array, opening: Opening, edges: Edges) -> float:
    """The instrument gap [m] beside points (2, 3) [m] that a lens (3,) [m] sees, without an interval."""
    ranges = np.linalg.norm(points - lens, axis=1) * opening.in_plane
    return float(widest(opening.half, ranges, opening.insets, *edges.shapes, TILTS)[0])


def edge_points(lens: Array, points: Array, opening: Opening, edges: Edges) -> Array:
    """Where the lines of sight along both edges touch the tissue (2, 3) [m], by the mean of the shapes."""
    ranges = np.linalg.norm(points - lens, axis=1) * opening.in_plane
    beyond = [mean_farther(float(ranges[n]), float(opening.insets[n]), edges.shapes[n]) for n in range(2)]
    return np.asarray(lens + (ranges + beyond)[:, None] * edges.bearings)


def worst_case(
    travel: Array,
    present: Array,
    first: Array,
    opening: Opening,
    edges: Edges,
    angular_error: float,
    image_error: float,
    shifts: Array,
    signs: Array,
) -> tuple[float, float]:
    """Least and greatest instrument gap [m] that bounded errors of points, edges and shape allow.

    `travel` (3,) [m] leads from the present lens to the first; `present` and `first` (2, 3) are the bearings
    of the points from there. `angular_error` [rad] bounds each bearing's error, and `image_error` the part of
    it that the image alone is to blame for, between a point and its edge; `shifts` (m, 3) [m] are the
    displacements of either lens, and `signs` the rows of (17) and (18) that are admitted, as for the error
    clouds. Both points are seen from the same two lenses, so they share the displacements. The greatest gap
    is infinite where a point may lie at infinity; the least is 0 where nothing bounds it from below.
    """
    near, far = admitted_ranges(travel, present, first, opening, angular_error, shifts, signs)
    return bounds_of_gap(near, far, opening, edges, image_error)


def admitted_ranges(
    travel: Array,
    present: Array,
    first: Array,
    opening: Opening,
    angular_error: float,
    shifts: Array,
    signs: Array,
) -> tuple[Array, Array]:
    """Least and greatest distance (2,) [m] of the points in the plane of the section; as `worst_case`.

    Displacements along the travel, which change the scale most, are admitted beside `shifts`.
    """
    along = travel / max(float(np.linalg.norm(travel)), TINY)
    farthest = float(np.linalg.norm(shifts, axis=1).max())
    every = np.concatenate([shifts, [farthest * along, -farthest * along]])
    near, far = ranges_under_errors(np.ascontiguousarray(travel), present, first, angular_error, every, signs)
    return (near * opening.in_plane, far * opening.in_plane) if near.size else (near, far)


def bounds_of_gap(
    near: Array, far: Array, opening: Opening, edges: Edges, image_error: float
) -> tuple[float, float]:
    """Least and greatest instrument gap [m] for the distances of `admitted_ranges`; as `worst_case`."""
    if not near.size:
        return 0.0, np.inf
    errors = (edges.error, image_error)
    lower, upper = gap_bounds(near, far, opening.half, opening.insets, *errors, *edges.shapes, TILTS)
    return max(lower - ROUGHNESS_BOUND, 0.0), upper + ROUGHNESS_BOUND
