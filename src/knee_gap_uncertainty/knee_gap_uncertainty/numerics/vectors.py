"""Vectors as triples of floats: the same short words in compiled kernels and in plain Python."""

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled

Vector: TypeAlias = tuple[float, float, float]


@compiled
def vector(array: npt.NDArray[np.float64]) -> Vector:
    """Array (3,) as a vector."""
    return array[0], array[1], array[2]


@compiled
def row(array: npt.NDArray[np.float64], i: int) -> Vector:
    """Row i of an array (n, 3) as a vector."""
    return array[i, 0], array[i, 1], array[i, 2]


@compiled
def column(array: npt.NDArray[np.float64], i: int) -> Vector:
    """Column i of an array (3, n) as a vector."""
    return array[0, i], array[1, i], array[2, i]


@compiled
def dot(u: Vector, v: Vector) -> float:
    """Inner product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@compiled
def cross(u: Vector, v: Vector) -> Vector:
    """Vector product."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@compiled
def add(u: Vector, v: Vector) -> Vector:
    """Sum u + v."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@compiled
def subtract(u: Vector, v: Vector) -> Vector:
    """Difference u - v."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@compiled
def scale(factor: float, u: Vector) -> Vector:
    """Vector u times a factor."""
    return factor * u[0], factor * u[1], factor * u[2]


@compiled
def norm(u: Vector) -> float:
    """Length of u."""
    return math.sqrt(dot(u, u))


@compiled
def unit(u: Vector) -> Vector:
    """Direction of u, which must not be zero."""
    length = norm(u)
    return u[0] / length, u[1] / length, u[2] / length


@compiled
def angle(u: Vector, v: Vector) -> float:
    """Angle between two vectors [rad], exact to the last digits near 0 and pi too, where arccos is not."""
    return math.atan2(norm(cross(u, v)), dot(u, v))
