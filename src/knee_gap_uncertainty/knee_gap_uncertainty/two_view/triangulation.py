"""Two bearings and the travel between them to a point, and two points to a gap: equations (1)-(6).

The labelling is the only one with which (1)-(5) give a positive parallax: b_n is the bearing from the first
lens A0 to the point G_n, a_n the one from the second lens A1, and t = A1 - A0.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.errors import CheiralityError, EpipoleError, UnderconstrainedError
from knee_gap_uncertainty.numerics.vectors import Vector, angle, cross, dot, norm, row, scale, vector
from knee_gap_uncertainty.two_view.two_views import TwoViews

# Angles closer to 0 or pi than this cannot be distinguished from it in double precision.
SMALLEST_ANGLE = 1e-9


@compiled
def triangle_angles(travel: Vector, own: Vector, other: Vector) -> tuple[float, float]:
    """Angles of the triangle at the lens where `travel` starts and where it ends [rad], (3) and (4).

    `own` is the bearing from the first of them, `other` from the second. With (t, b_n, a_n) they are alpha_n
    and beta_n; with (-t, a_n, b_n) the same two the other way round.
    """
    return angle(travel, own), angle(scale(-1.0, travel), other)


@compiled
def ray_length(travel: float, own_angle: float, other_angle: float) -> float:
    """Length of the ray from the lens of `own_angle`, by the sine rule: (2) for b_n, (1) for a_n.

    `travel` is the distance of the lenses; sin gamma = sin(alpha + beta) by (5).
    """
    return travel * math.sin(other_angle) / math.sin(own_angle + other_angle)


class Triangulation(NamedTuple):
    """Both points as seen from either lens; index n of each array is the point G_n.

    `alpha`, `beta`, `gamma` (2,): angles at the first lens, the second lens and the point [rad].
    `points_first` and `points_second` (2, 3): where (2) and (1) put the points [m]; they differ where the
    rays do not meet.
    """

    alpha: npt.NDArray[np.float64]
    beta: npt.NDArray[np.float64]
    gamma: npt.NDArray[np.float64]
    points_first: npt.NDArray[np.float64]
    points_second: npt.NDArray[np.float64]

    @property
    def gap_first(self) -> float:
        """Gap |b_1 - b_0| by (6) [m]."""
        return float(np.linalg.norm(self.points_first[1] - self.points_first[0]))

    @property
    def gap_second(self) -> float:
        """Gap |a_1 - a_0| by (6) [m]."""
        return float(np.linalg.norm(self.points_second[1] - self.points_second[0]))


def triangulate(views: TwoViews) -> Triangulation:
    """Both points from both lenses, (1)-(5).

    Raises EpipoleError, CheiralityError or UnderconstrainedError where a pair of rays gives no point.
    """
    angles, lengths, depths, parallax = solve_triangles(views.travel, views.bearings_0, views.bearings_1)
    for n in range(2):
        refuse_bad_triangle(n, angles[n].tolist(), depths[n].tolist(), float(parallax[n]))
    return Triangulation(
        alpha=angles[:, 0],
        beta=angles[:, 1],
        gamma=math.pi - angles[:, 0] - angles[:, 1],
        points_first=views.lens_0 + lengths[:, :1] * views.bearings_0,
        points_second=views.lens_1 + lengths[:, 1:] * views.bearings_1,
    )


@compiled
def solve_triangles(
    travel: npt.NDArray[np.float64], bearings_0: npt.NDArray[np.float64], bearings_1: npt.NDArray[np.float64]
) -> tuple[
    npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]
]:
    """Angles [rad], lengths by (2) and (1) [m], depths of closest approach [m] and parallax [rad].

    The first three are (2, 2), rows points and columns lenses; the parallax (2,) is the angle between two
    rays.
    """
    angles, lengths, depths, parallax = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2)), np.empty(2)
    t = vector(travel)
    for n in range(2):
        own, other = row(bearings_0, n), row(bearings_1, n)
        angles[n, 0], angles[n, 1] = triangle_angles(t, own, other)
        lengths[n, 0] = ray_length(norm(t), angles[n, 0], angles[n, 1])
        lengths[n, 1] = ray_length(norm(t), angles[n, 1], angles[n, 0])
        depths[n, 0], depths[n, 1] = closest_approach(t, own, other)
        parallax[n] = angle(own, other)
    return angles, lengths, depths, parallax


@compiled
def closest_approach(travel: Vector, own: Vector, other: Vector) -> tuple[float, float]:
    """Distances along the two rays to where they come closest [m]; negative is behind the lens."""
    normal = cross(own, other)
    squared = dot(normal, normal)
    return dot(cross(travel, other), normal) / squared, dot(cross(travel, own), normal) / squared


def refuse_bad_triangle(n: int, angles: list[float], depths: list[float], parallax: float) -> None:
    """Raise what is wrong with the rays to point n, if anything is."""
    for name, value in zip(("first", "second"), angles, strict=True):
        if not SMALLEST_ANGLE < value < math.pi - SMALLEST_ANGLE:
            raise EpipoleError(
                f"the bearing from the {name} lens to point {n} lies along the travel "
                f"({math.degrees(value):.3g} deg from it): it must span a triangle with it"
            )
    if parallax < SMALLEST_ANGLE:
        raise UnderconstrainedError(f"the rays to point {n} are parallel: the point is at infinity")
    gamma = math.pi - sum(angles)
    if gamma <= 0 or min(depths) <= 0:
        raise CheiralityError(
            f"the rays to point {n} must meet in front of both lenses: parallax "
            f"{math.degrees(gamma):.3g} deg, closest {depths[0]:.3g} m and {depths[1]:.3g} m along them"
        )
