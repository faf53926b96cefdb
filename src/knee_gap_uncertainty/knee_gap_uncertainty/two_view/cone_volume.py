"""All places that admitted errors allow a point, not samples of them: how near two such volumes come.

A point lies on a ray within psi of its bearing, at a length between the shortest and the longest by (8), from
a lens displaced by at most DT: the frustum of a cone between two spherical caps, blurred by a ball. The
clouds draw that on rings of eight points, a quarter of which have no point at all, so a smallest distance of
samples is not a bound where the rings are wide beside the gap. Of the convex hull of the volume the farthest
point in any direction is known in closed form, and that is all the search for the distance needs.
"""

import math
from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_uncertainty.numerics.vectors import Vector, add, dot, norm, scale, subtract, unit
from knee_gap_uncertainty.two_view.convex_distance import ACCURACY, MOST_STEPS, TOUCHING, closest_of_simplex


class ConeVolume(NamedTuple):
    """Points at lengths [m] from `shortest` to `longest` within `half_angle` [rad] of the unit vector `axis`.

    The apex is anywhere within `blur` [m] of the origin.
    """

    axis: Vector
    shortest: float
    longest: float
    half_angle: float
    blur: float


@compiled
def farthest_point(volume: ConeVolume, direction: Vector) -> Vector:
    """Point of the volume's hull that lies farthest in the direction, which must not be zero."""
    towards = unit(direction)
    along = dot(volume.axis, towards)
    across = subtract(towards, scale(along, volume.axis))
    off = math.atan2(norm(across), along)
    ray = volume.axis
    if off <= volume.half_angle:
        ray = towards
    elif norm(across) > 0.0:
        side = unit(across)
        ray = add(scale(math.cos(volume.half_angle), volume.axis), scale(math.sin(volume.half_angle), side))
    length = volume.longest if dot(ray, towards) > 0.0 else volume.shortest
    found: Vector = add(scale(length, ray), scale(volume.blur, towards))
    return found


@compiled
def volume_distance(one: ConeVolume, other: ConeVolume) -> float:
    """Lower bound of the distance of the hulls of two volumes [m]: 0 where they meet, else true to 1 %."""
    simplex = np.empty((4, 3))
    count = 0
    closest = subtract(scale(one.longest, one.axis), scale(other.longest, other.axis))
    if not norm(closest) > 0.0:
        return 0.0
    extent = 0.0
    bound = 0.0
    for _ in range(MOST_STEPS):
        corner = subtract(farthest_point(one, scale(-1.0, closest)), farthest_point(other, closest))
        extent = max(extent, norm(corner))
        ahead = dot(closest, corner)
        if ahead > TOUCHING * extent * norm(closest):
            bound = max(bound, ahead / norm(closest))
            if count > 0 and bound >= (1.0 - ACCURACY) * norm(closest):
                break
        simplex[count, 0], simplex[count, 1], simplex[count, 2] = corner
        count, closest = closest_of_simplex(simplex, count + 1)
        if norm(closest) <= TOUCHING * extent:
            return 0.0
    return float(bound)
