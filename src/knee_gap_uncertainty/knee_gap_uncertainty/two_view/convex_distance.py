"""Distance of two clouds' convex hulls, 0 if they overlap.

The clouds are samples of volumes that are very nearly convex (the frustum of a cone, blurred by the displaced
lens), so where hulls meet, the two points of the gap may be one, and the smallest distance between samples
means nothing; if hulls come far nearer than samples do, it means little. Decided by the point of the hulls'
difference that is closest to the origin (Gilbert, Johnson, Keerthi 1988).
"""

import math

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_uncertainty.numerics.vectors import Vector, add, column, cross, dot, norm, row, scale, subtract
from knee_gap_uncertainty.two_view.slices import Boxes, SlicedCloud

# Hulls closer than this share of their extent touch. The search takes about ten steps; one that does not end,
# because the hulls very nearly touch, is decided the safe way.
TOUCHING = 1e-9
MOST_STEPS = 100
ACCURACY = 0.01


@compiled
def hulls_meet(
    one: SlicedCloud,
    one_far: npt.NDArray[np.float64],
    other: SlicedCloud,
    other_far: npt.NDArray[np.float64],
    guess: Vector,
) -> bool:
    """Whether the convex hulls of two clouds, each with its far points (3, 8, n), have a point in common.

    `guess` is a direction from the other cloud to this one, tried first as normal of a plane between them.
    """
    return not hull_distance(one, one_far, other, other_far, guess, 0.0) > 0.0


@compiled
def hull_distance(
    one: SlicedCloud,
    one_far: npt.NDArray[np.float64],
    other: SlicedCloud,
    other_far: npt.NDArray[np.float64],
    guess: Vector,
    enough: float,
) -> float:
    """Lower bound of the distance of the hulls [m]: 0 where they meet, else above `enough` or true to 1 %.

    Arguments as those of `hulls_meet`.
    """
    simplex = np.empty((4, 3))
    count = 0
    closest = guess
    extent = 0.0
    bound = 0.0
    for _ in range(MOST_STEPS):
        corner = subtract(
            extreme_point(one, one_far, scale(-1.0, closest)), extreme_point(other, other_far, closest)
        )
        extent = max(extent, norm(corner))
        ahead = dot(closest, corner)
        if ahead > TOUCHING * extent * norm(closest):
            bound = max(bound, ahead / norm(closest))
            if bound > enough or (count > 0 and bound >= (1.0 - ACCURACY) * norm(closest)):
                return float(bound)
        simplex[count, 0], simplex[count, 1], simplex[count, 2] = corner
        count, closest = closest_of_simplex(simplex, count + 1)
        if norm(closest) <= TOUCHING * extent:
            return 0.0
    return float(bound)


@compiled
def extreme_point(cloud: SlicedCloud, far: npt.NDArray[np.float64], direction: Vector) -> Vector:
    """Point of the cloud, or of its far points, that lies farthest in the direction."""
    best = -math.inf
    found = (0.0, 0.0, 0.0)
    for i in range(cloud.starts.size - 1):
        if reach(cloud.slices, i, direction) > best:
            for j in range(cloud.starts[i], cloud.starts[i + 1]):
                point = column(cloud.points, j)
                if dot(point, direction) > best:
                    best, found = dot(point, direction), point
    for spoke in range(far.shape[1]):
        for j in range(far.shape[2]):
            point = (far[0, spoke, j], far[1, spoke, j], far[2, spoke, j])
            if dot(point, direction) > best:
                best, found = dot(point, direction), point
    return found


@compiled
def reach(boxes: Boxes, i: int, direction: Vector) -> float:
    """How far box i extends in the direction: no point in it lies farther."""
    total = 0.0
    for axis in range(3):
        total += max(boxes.low[axis, i] * direction[axis], boxes.high[axis, i] * direction[axis])
    return total


@compiled
def closest_of_simplex(simplex: npt.NDArray[np.float64], count: int) -> tuple[int, Vector]:
    """Point of the simplex of the first `count` rows that is closest to the origin.

    It is the foot of the origin on one of the faces, inside that face; the closest such foot of all is the
    answer. `simplex` is left with the corners of that face, whose number is returned with the point.
    """
    best = math.inf
    closest = (0.0, 0.0, 0.0)
    face = 0
    for candidate in range(1, 1 << count):
        inside, foot = foot_on_face(simplex, candidate)
        if inside and dot(foot, foot) < best:
            best, closest, face = dot(foot, foot), foot, candidate
    kept = 0
    for i in range(count):
        if face >> i & 1:
            simplex[kept] = simplex[i]
            kept += 1
    return kept, closest


@compiled
def foot_on_face(simplex: npt.NDArray[np.float64], face: int) -> tuple[bool, Vector]:
    """Foot of the origin on the face of the corners whose bits are set, and whether it lies within it."""
    corners = np.zeros((4, 3))
    count = 0
    for i in range(4):
        if face >> i & 1:
            corners[count] = simplex[i]
            count += 1
    a, b, c, d = row(corners, 0), row(corners, 1), row(corners, 2), row(corners, 3)
    if count == 1:
        return True, a
    if count == 2:
        edge = subtract(b, a)
        share = -dot(a, edge) / dot(edge, edge)
        return 0.0 < share < 1.0, add(a, scale(share, edge))
    if count == 3:
        normal = cross(subtract(b, a), subtract(c, a))
        inside = (
            dot(normal, cross(b, c)) > 0.0
            and dot(normal, cross(c, a)) > 0.0
            and dot(normal, cross(a, b)) > 0.0
        )
        return inside, scale(dot(normal, a) / dot(normal, normal), normal)
    volumes = (dot(b, cross(c, d)), -dot(a, cross(c, d)), dot(a, cross(b, d)), -dot(a, cross(b, c)))
    return min(volumes) > 0.0 or max(volumes) < 0.0, (0.0, 0.0, 0.0)
