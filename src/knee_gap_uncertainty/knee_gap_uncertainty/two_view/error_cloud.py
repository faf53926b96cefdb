"""Error cloud of a point of the gap, under all admitted errors: equations (21)-(25), from either lens.

A cloud is seen from the ray's own lens, its apex, which is at the origin: the clouds of b_n have A0 as apex
and the travel t, those of a_n have A1 and -t. Everything below is written for the one and serves for the
other.
"""

import math
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.errors import BadInputError, EpipoleError
from knee_gap_uncertainty.numerics.vectors import Vector, add, cross, norm, row, scale, unit, vector
from knee_gap_uncertainty.two_view.angle_sets import SIGNS, Signs, perturbed_angles
from knee_gap_uncertainty.two_view.slices import places_by_inverse
from knee_gap_uncertainty.two_view.translation_volume import displaced_travel, displacements
from knee_gap_uncertainty.two_view.triangulation import SMALLEST_ANGLE, ray_length, triangle_angles
from knee_gap_uncertainty.two_view.two_views import TwoViews

Apex: TypeAlias = Literal["first", "second"]

# Rotations phi of Delta g about the ray, each taken both ways: eight points a ring.
PHI = (0.0, math.pi / 6, math.pi / 4, math.pi / 2)
COS_PHI = np.cos(PHI)
SIN_PHI = np.sin(PHI)
SPOKES = 2 * len(PHI)

# Where a ray under admitted errors meets the other nowhere, its point is put this many travels away: no
# distance is taken to it, but it is the direction in which the cloud is unbounded.
FAR = 1e3


class ErrorCloud(NamedTuple):
    """Points around one end of the gap, in rings about the ray; coordinates [m], apex at the origin.

    `points` (3, 8, rings): coordinates, spokes, rings, coarsely in order of length; `starts`: where the
    slices of each spoke begin, with the end of the last. `far` (3, 8, more): rings for rays that do not meet,
    drawn at a great distance. `shortest` and `longest` of all rays [m], the latter at most that distance.
    `smallest_angle`: least angle alpha', beta' or pi less one of them [rad]; where it leaves no triangle, the
    cloud is empty.
    """

    points: npt.NDArray[np.float64]
    starts: npt.NDArray[np.int64]
    far: npt.NDArray[np.float64]
    shortest: float
    longest: float
    smallest_angle: float


@compiled
def trace_cloud(
    travel: Vector,
    own: Vector,
    other: Vector,
    angular_error: float,
    shifts: npt.NDArray[np.float64],
    signs: npt.NDArray[np.float64],
) -> ErrorCloud:
    """Cloud about the end of the ray `own`, for all `shifts` of both lenses and all rows of `signs`.

    `travel` leads from the ray's own lens to the other one; `other` is the bearing from there.
    """
    lengths, smallest_angle = ring_lengths(travel, own, other, angular_error, shifts, signs)
    if not smallest_angle > SMALLEST_ANGLE:
        nothing = np.empty((3, SPOKES, 0))
        return ErrorCloud(nothing, np.zeros(1, np.int64), nothing, math.nan, math.nan, smallest_angle)
    places, starts = places_by_inverse(lengths[lengths < math.inf])
    points = np.empty((3, SPOKES, places.size))
    far = np.empty((3, SPOKES, lengths.size - places.size))
    ring, drawn = 0, 0
    for p in range(shifts.shape[0]):
        apex = row(shifts, p)
        for q in range(shifts.shape[0]):
            displaced = displaced_travel(travel, apex, row(shifts, q))
            across = unit(cross(own, cross(displaced, own)))
            for _ in range(signs.shape[0]):
                length = lengths[ring]
                if length < math.inf:
                    draw_ring(points, places[drawn], apex, own, across, length, angular_error)
                    drawn += 1
                else:
                    draw_ring(far, ring - drawn, apex, own, across, FAR * norm(travel), angular_error)
                ring += 1
    endless = FAR * norm(travel)
    return ErrorCloud(
        points, starts, far, min(lengths.min(), endless), min(lengths.max(), endless), smallest_angle
    )


@compiled
def ring_lengths(
    travel: Vector,
    own: Vector,
    other: Vector,
    angular_error: float,
    shifts: npt.NDArray[np.float64],
    signs: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], float]:
    """L' of every ring by (8), infinite where alpha' + beta' reaches pi [m], and the smallest angle [rad]."""
    lengths = np.empty(shifts.shape[0] ** 2 * signs.shape[0])
    smallest_angle = math.inf
    ring = 0
    for p in range(shifts.shape[0]):
        for q in range(shifts.shape[0]):
            displaced = displaced_travel(travel, row(shifts, p), row(shifts, q))
            distance = norm(displaced)
            angles = triangle_angles(displaced, own, other)
            smallest_angle = min(smallest_angle, math.pi - max(angles))
            for k in range(signs.shape[0]):
                own_angle, other_angle = perturbed_angles(angles, signs[k], angular_error)
                smallest_angle = min(smallest_angle, own_angle, other_angle)
                meet = own_angle + other_angle < math.pi
                lengths[ring] = ray_length(distance, own_angle, other_angle) if meet else math.inf
                ring += 1
    return lengths, smallest_angle


@compiled
def draw_ring(
    points: npt.NDArray[np.float64],
    ring: int,
    apex: Vector,
    bearing: Vector,
    across: Vector,
    length: float,
    angular_error: float,
) -> None:
    """Write the ring of points at `length` [m] from the displaced apex, psi about the bearing: (21)-(23).

    `across` is the direction of Delta g, (24); the spokes are it and its opposite, turned by phi about the
    bearing.
    """
    third = cross(bearing, across)
    centre = add(apex, scale(length * math.cos(angular_error), bearing))
    radius = length * math.sin(angular_error)
    for i in range(COS_PHI.size):
        spoke = add(scale(radius * COS_PHI[i], across), scale(radius * SIN_PHI[i], third))
        for axis in range(3):
            points[axis, 2 * i, ring] = centre[axis] + spoke[axis]
            points[axis, 2 * i + 1, ring] = centre[axis] - spoke[axis]


def error_clouds(
    views: TwoViews,
    *,
    angular_error: float,
    translation_error: float,
    signs: Signs = "all",
    apex: Apex = "first",
    radii: int = 1,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The clouds E0 and E1 about the two points (N, 3) [m], in the frame of the views; errors in rad and m.

    Only places at a finite distance are listed. Raises EpipoleError where an admitted error turns a
    bearing into the direction of travel.
    """
    if signs not in SIGNS or apex not in ("first", "second"):
        raise BadInputError(
            f"signs must be one of {', '.join(SIGNS)} and apex first or second, got {signs}, {apex}"
        )
    first = apex == "first"
    travel = vector(views.travel if first else -views.travel)
    lens = views.lens_0 if first else views.lens_1
    own, other = (views.bearings_0, views.bearings_1) if first else (views.bearings_1, views.bearings_0)
    shifts = displacements(translation_error, radii)
    clouds = []
    for n in range(2):
        cloud = trace_cloud(travel, row(own, n), row(other, n), angular_error, shifts, SIGNS[signs])
        refuse_parallel(cloud.smallest_angle)
        clouds.append(lens + cloud.points.reshape(3, -1).T)
    return clouds[0], clouds[1]


def refuse_parallel(smallest_angle: float) -> None:
    """Raise EpipoleError where the least angle [rad] of a cloud leaves no triangle."""
    if not smallest_angle > SMALLEST_ANGLE:
        raise EpipoleError(
            "under the admitted errors a bearing lies along the travel: the angle between them, less the "
            f"angular error, must be positive, it is {math.degrees(smallest_angle):.3g} deg"
        )
