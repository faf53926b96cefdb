"""The compiled kernels of the instrument gap; the symbols are those of `instrument_gap`."""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.numerics.vectors import row, vector
from knee_gap_uncertainty.two_view.error_cloud import ring_lengths
from knee_gap_uncertainty.two_view.triangulation import SMALLEST_ANGLE

# Places on the confidence ellipse of the two inverse distances at which its extremes are looked for.
AROUND = 64
# Errors of an edge at which the extremes of a side are looked for, from one bound to the other.
EDGE_STEPS = 5

TINY = 1e-12


@compiled
def side(distance: float, angle: float, inset: float, radius: float, slope: float) -> float:
    """How far out [m] an instrument comes on one side, at `angle` between its axis and the edge."""
    beside = distance * np.sin(max(inset, 0.0))
    farther = np.sqrt(2.0 * radius * beside) if radius > 0.0 else beside / slope
    return float((distance + farther) * np.sin(angle) - radius * (1.0 - np.cos(angle)))


@compiled
def mean_farther(distance: float, inset: float, shapes: Array) -> float:
    """How much farther [m] an edge lies than the point beside it, as a mean over the shapes (n, 2)."""
    total = 0.0
    for k in range(shapes.shape[0]):
        beside = distance * np.sin(max(inset, 0.0))
        radius, slope = shapes[k, 0], shapes[k, 1]
        total += np.sqrt(2.0 * radius * beside) if radius > 0.0 else beside / slope
    return total / shapes.shape[0]


@compiled
def mean_side(distance: float, angle: float, inset: float, shapes: Array) -> tuple[float, float]:
    """Mean [m] and variance [m^2] of `side` over the admitted shapes (n, 2)."""
    total, squares = 0.0, 0.0
    for k in range(shapes.shape[0]):
        value = side(distance, angle, inset, shapes[k, 0], shapes[k, 1])
        total += value
        squares += value * value
    mean = total / shapes.shape[0]
    return mean, max(squares / shapes.shape[0] - mean * mean, 0.0)


@compiled
def reaches_of(
    near: float, far: float, inset: float, edge_error: float, image_error: float, shapes: Array
) -> tuple[Array, Array]:
    """Errors (EDGE_STEPS + 1,) [rad] of an edge, and how far away (EDGE_STEPS + 1, n, 4) [m] it lies then.

    Distances of the point beside it lie from `near` to `far` [m]. The edge is wrong by up to `edge_error`
    [rad], which moves it against axis and point alike, and the point against it by up to `image_error` [rad]
    more. The last axis holds the ends of both.
    """
    errors, reaches = np.empty(EDGE_STEPS + 1), np.empty((EDGE_STEPS + 1, shapes.shape[0], 4))
    for step in range(EDGE_STEPS + 1):
        if step < EDGE_STEPS:
            error = edge_error * (2.0 * step / (EDGE_STEPS - 1) - 1.0)
        else:
            # Where the point may lie on the line of sight along the edge.
            error = min(max(inset - image_error, -edge_error), edge_error)
        errors[step] = error
        for place in range(4):
            sine = np.sin(max(inset - error + (image_error if place % 2 else -image_error), 0.0))
            distance = near if place < 2 else far
            beside = distance * sine
            for k in range(shapes.shape[0]):
                radius, slope = shapes[k, 0], shapes[k, 1]
                farther = np.sqrt(2.0 * radius * beside) if radius > 0.0 else beside / slope
                reaches[step, k, place] = distance + farther if distance < np.inf else np.inf
    return errors, reaches


@compiled
def side_range(errors: Array, reaches: Array, angle: float, shapes: Array) -> tuple[float, float]:
    """Least and greatest `side` [m] that the admitted errors (`reaches_of`) allow, at an angle.

    The side is not monotone in the edge's error, since an edge nearer to its point lies nearer to the lens.
    """
    least, greatest = np.inf, -np.inf
    for step in range(errors.size):
        wrong = angle + errors[step]
        sine, fallen = np.sin(wrong), 1.0 - np.cos(wrong)
        endless = np.inf if wrong > 0.0 else -np.inf
        for k in range(shapes.shape[0]):
            bulge = shapes[k, 0] * fallen
            for place in range(4):
                reach = reaches[step, k, place]
                value = reach * sine - bulge if reach < np.inf else endless
                least, greatest = min(least, value), max(greatest, value)
    return least, greatest


@compiled
def opening_between(points: Array, edges: Array) -> tuple[float, Array, Array, Array, Array]:
    """The fields of `Opening`: half [rad], insets (2,) [rad], in_plane (2,), view (3,), across (3,)."""
    view, across = edges[0] + edges[1], edges[1] - edges[0]
    view = view / max(np.sqrt(np.sum(view * view)), TINY)
    across = across / max(np.sqrt(np.sum(across * across)), TINY)
    half = np.arctan2(np.sum(edges[1] * across), np.sum(edges[1] * view))
    insets, in_plane = np.empty(2), np.empty(2)
    for n in range(2):
        # Points outside the opening have a positive angle on both sides.
        forward = np.sum(points[n] * view)
        aside = np.sum(points[n] * across) * (2.0 * n - 1.0)
        insets[n], in_plane[n] = np.arctan2(aside, forward) - half, np.hypot(forward, aside)
    return half, insets, in_plane, view, across


@compiled
def ends_over_ellipse(
    ranges: Array,
    covariance: Array,
    radius: float,
    half: float,
    insets: Array,
    shapes_0: Array,
    shapes_1: Array,
    tilt: float,
) -> tuple[float, float, float]:
    """Least and greatest gap [m] over the ellipse of the points' inverse distances, and its variance [m^2].

    `covariance` (2, 2) [1/m^2] is that of the inverse distances, in which errors of motion stereo are close
    to Gaussian; the ellipse has `radius` standard deviations. The greatest gap is infinite where the ellipse
    reaches infinite distances.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    near, least, greatest = np.empty(AROUND), np.inf, -np.inf
    small = 0.1  # [-] of a standard deviation: where the gap is as good as linear
    for k in range(AROUND):
        angle = 2.0 * np.pi * k / AROUND
        aside = root[:, 0] * np.cos(angle) + root[:, 1] * np.sin(angle)
        near[k] = at_tilt(half, 1.0 / (1.0 / ranges + small * aside), insets, shapes_0, shapes_1, tilt)[0]
        inverse = 1.0 / ranges + radius * aside
        if inverse.min() > 0.0:
            gap = at_tilt(half, 1.0 / inverse, insets, shapes_0, shapes_1, tilt)[0]
            least, greatest = min(least, gap), max(greatest, gap)
        else:
            greatest = np.inf
    variance = np.max((near - near.mean()) ** 2) / small**2
    return (least if least < np.inf else 0.0), greatest, variance


@compiled
def edge_slopes(
    ranges: Array, half: float, insets: Array, shapes_0: Array, shapes_1: Array, tilt: float
) -> Array:
    """Change (2,) of the gap with the direction of either edge [m/rad]."""
    step = 1e-3
    slopes = np.zeros(2)
    for n in range(2):
        angle, shapes = (half + tilt, shapes_0) if n == 0 else (half - tilt, shapes_1)
        outer = mean_side(ranges[n], angle + step, insets[n] - step, shapes)[0]
        inner = mean_side(ranges[n], angle - step, insets[n] + step, shapes)[0]
        slopes[n] = (outer - inner) / (2.0 * step)
    return slopes


@compiled
def at_tilt(
    half: float, ranges: Array, insets: Array, shapes_0: Array, shapes_1: Array, tilt: float
) -> tuple[float, float]:
    """Gap [m] of an instrument at a tilt [rad], and the variance of the shapes [m^2]."""
    first, variance_0 = mean_side(ranges[0], half + tilt, insets[0], shapes_0)
    second, variance_1 = mean_side(ranges[1], half - tilt, insets[1], shapes_1)
    return first + second, variance_0 + variance_1


@compiled
def widest(
    half: float, ranges: Array, insets: Array, shapes_0: Array, shapes_1: Array, tilts: Array
) -> tuple[float, float, float]:
    """Largest gap [m] over the tilts, the tilt [rad] that gives it, and the deviation of the shapes there."""
    best, at, deviation = -np.inf, 0.0, 0.0
    for k in range(tilts.size):
        gap, variance = at_tilt(half, ranges, insets, shapes_0, shapes_1, tilts[k])
        if gap > best:
            best, at, deviation = gap, tilts[k], np.sqrt(variance)
    return best, at, deviation


@compiled
def ranges_under_errors(
    travel: Array, present: Array, first: Array, angular_error: float, shifts: Array, signs: Array
) -> tuple[Array, Array]:
    """Least and greatest distance (2,) [m] of both points from the present lens.

    Empty where an admitted error turns a bearing into the direction of travel.
    """
    t = vector(travel)
    near, far = np.full(2, np.inf), np.zeros(2)
    for n in range(2):
        lengths, angle = ring_lengths(t, row(present, n), row(first, n), angular_error, shifts, signs)
        if not angle > SMALLEST_ANGLE:
            return np.empty(0), np.empty(0)
        near[n], far[n] = np.min(lengths), np.max(lengths)
    return near, far


@compiled
def gap_bounds(
    near: Array,
    far: Array,
    half: float,
    insets: Array,
    edge_error: float,
    image_error: float,
    shapes_0: Array,
    shapes_1: Array,
    tilts: Array,
) -> tuple[float, float]:
    """Gap [m] that is free whatever the admitted errors, at the tilt where most is, and what none exceeds.

    The first is that of tilts within the lines of sight along the edges: only there tissue is known to be
    absent. The second is that of any tilt.
    """
    first, second = (
        reaches_of(near[0], far[0], insets[0], edge_error, image_error, shapes_0),
        reaches_of(near[1], far[1], insets[1], edge_error, image_error, shapes_1),
    )
    free, greatest = 0.0, 0.0
    for k in range(tilts.size):
        one = side_range(first[0], first[1], half + tilts[k], shapes_0)
        other = side_range(second[0], second[1], half - tilts[k], shapes_1)
        if abs(tilts[k]) <= max(half - edge_error, 0.0):
            free = max(free, one[0] + other[0])
        greatest = max(greatest, one[1] + other[1])
    return free, greatest
