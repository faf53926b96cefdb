"""Rotations as quaternions x, y, z, w, compiled: several are calculated for every tracked pose and image.

The arithmetic is that of scipy's Rotation, which takes ten times as long for a single rotation.
"""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array

# [rad] below which the ratio of an angle to its sine is a series.
SMALL = 1e-3


@compiled
def unit_quaternion(quaternion: Array) -> Array:
    """A quaternion (4,), which is not zero, at unit length."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    length = np.sqrt(x * x + y * y + z * z + w * w)
    return np.array([x / length, y / length, z / length, w / length])


@compiled
def product(second: Array, first: Array) -> Array:
    """Unit quaternion (4,) of the rotation `first`, then `second`."""
    x, y, z, w = second[0], second[1], second[2], second[3]
    a, b, c, d = first[0], first[1], first[2], first[3]
    return unit_quaternion(
        np.array(
            [
                w * a + d * x + (y * c - z * b),
                w * b + d * y + (z * a - x * c),
                w * c + d * z + (x * b - y * a),
                w * d - x * a - y * b - z * c,
            ]
        )
    )


@compiled
def inverse(quaternion: Array) -> Array:
    """The inverse (4,) of a unit quaternion."""
    return np.array([-quaternion[0], -quaternion[1], -quaternion[2], quaternion[3]])


@compiled
def canonical(quaternion: Array) -> Array:
    """The one of a quaternion (4,) and its opposite, which are the same rotation, whose w is not negative."""
    negative = quaternion[3] < 0.0
    if quaternion[3] == 0.0:
        for k in range(3):
            if quaternion[k] != 0.0:
                negative = quaternion[k] < 0.0
                break
    return -quaternion if negative else quaternion.copy()


@compiled
def matrix(quaternion: Array) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion (4,)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    rotation = np.empty((3, 3))
    rotation[0, 0] = x * x - y * y - z * z + w * w
    rotation[1, 0] = 2.0 * (x * y + z * w)
    rotation[2, 0] = 2.0 * (x * z - y * w)
    rotation[0, 1] = 2.0 * (x * y - z * w)
    rotation[1, 1] = -x * x + y * y - z * z + w * w
    rotation[2, 1] = 2.0 * (y * z + x * w)
    rotation[0, 2] = 2.0 * (x * z + y * w)
    rotation[1, 2] = 2.0 * (y * z - x * w)
    rotation[2, 2] = -x * x - y * y + z * z + w * w
    return rotation


@compiled
def rotation_vector(quaternion: Array) -> Array:
    """Rotation vector (3,) [rad] of a unit quaternion (4,), the shorter way round."""
    q = -quaternion if quaternion[3] < 0.0 else quaternion.copy()
    angle = 2.0 * np.arctan2(np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]), q[3])
    if angle <= SMALL:
        square = angle * angle
        factor = 2.0 + square / 12.0 + 7.0 * square * square / 2880.0
    else:
        factor = angle / np.sin(angle / 2.0)
    return np.array([factor * q[0], factor * q[1], factor * q[2]])


@compiled
def from_rotation_vector(vector: Array) -> Array:
    """Unit quaternion (4,) of a rotation vector (3,) [rad]."""
    angle = np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if angle <= SMALL:
        square = angle * angle
        factor = 0.5 - square / 48.0 + square * square / 3840.0
    else:
        factor = np.sin(angle / 2.0) / angle
    return np.array([factor * vector[0], factor * vector[1], factor * vector[2], np.cos(angle / 2.0)])


@compiled
def between(before: Array, after: Array, share: float) -> Array:
    """Unit quaternion (4,) at a share of the way from one rotation to another, by slerp; quaternions (4,)."""
    start = unit_quaternion(before)
    turn = rotation_vector(product(unit_quaternion(after), inverse(start)))
    return canonical(product(from_rotation_vector(share * turn), start))


@compiled
def turn_from(before: Array, after: Array) -> Array:
    """Rotation vector (3,) [rad] in the fixed frame from one rotation to another; quaternions (4,)."""
    return rotation_vector(product(unit_quaternion(after), inverse(unit_quaternion(before))))


def warm_up() -> None:
    """Compile all of them, or load them from disk, so that the first pose is not late."""
    one = unit_quaternion(np.array([0.1, 0.2, 0.3, 0.9]))
    matrix(canonical(product(one, inverse(from_rotation_vector(rotation_vector(one))))))
    turn_from(one, between(one, canonical(-one), 0.5))
