"""The small matrices of a tangent plane and of a warp, compiled: a call of numpy for each would cost more."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array


def _relative(base: Array, other: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) of a rigid transform (4, 4) in the frame of another."""
    rotation, shift = np.zeros((3, 3)), np.zeros(3)
    for i in range(3):
        for k in range(3):
            shift[i] += base[k, i] * (other[k, 3] - base[k, 3])
            for j in range(3):
                rotation[i, j] += base[k, i] * other[k, j]
    return rotation, shift


def _directions_of(planes: Array, bearings: Array, first: Array, anchor: Array, view: Array) -> Array:
    """Directions (m n + 1, 3) from a view, to points of planes (m, 3) along bearings (n, 3) of an anchor.

    `first`, `anchor` and `view` (4, 4) are the poses of the lenses; the planes are given in the first's
    frame. NaN for points behind the anchor. The last direction is that of the first bearing, at infinity.
    """
    in_first, from_first = relative(first, anchor)
    in_anchor, moved = relative(anchor, view)
    count = bearings.shape[0]
    directions = np.full((planes.shape[0] * count + 1, 3), np.nan)
    local = np.zeros(3)
    for m in range(planes.shape[0]):
        scale = 1.0
        for k in range(3):
            scale -= planes[m, k] * from_first[k]
        for j in range(3):
            local[j] = 0.0
            for k in range(3):
                local[j] += planes[m, k] * in_first[k, j]
            local[j] /= scale
        for n in range(count):
            inverse = local[0] * bearings[n, 0] + local[1] * bearings[n, 1] + local[2] * bearings[n, 2]
            # Inverse distances below zero lie behind the lens.
            if inverse > 0.0:
                for j in range(3):
                    value = 0.0
                    for k in range(3):
                        value += (bearings[n, k] - inverse * moved[k]) * in_anchor[k, j]
                    directions[m * count + n, j] = value
    for j in range(3):
        value = 0.0
        for k in range(3):
            value += bearings[0, k] * in_anchor[k, j]
        directions[planes.shape[0] * count, j] = value
    return directions


def _prediction_of(
    pixels: Array,
    covariance: Array,
    position_noise: float,
    shape_noise: float,
    difference: float,
    step: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Position (2,), shape (2, 2), their covariance (6, 6), change by the plane (6, 3), and parallax (2,).

    `pixels` (36, 2) are those of the directions to seven planes, the present one and `step` [1/m] to either
    side along each axis, at a place and `difference` [px] beside it; `covariance` (3, 3) is the plane's. The
    deviations of the noise are in pixels and without a unit.
    """
    parameters = np.empty((7, 6))
    for m in range(7):
        p = 5 * m
        for k in range(2):
            parameters[m, k] = pixels[p, k]
            parameters[m, 2 + 2 * k] = (pixels[p + 1, k] - pixels[p + 2, k]) / (2.0 * difference)
            parameters[m, 3 + 2 * k] = (pixels[p + 3, k] - pixels[p + 4, k]) / (2.0 * difference)
    jacobian = np.empty((6, 3))
    for i in range(6):
        for k in range(3):
            jacobian[i, k] = (parameters[1 + k, i] - parameters[4 + k, i]) / (2.0 * step)
    spread = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(3):
                for m in range(3):
                    spread[i, j] += jacobian[i, k] * covariance[k, m] * jacobian[j, m]
        spread[i, i] += position_noise**2 if i < 2 else shape_noise**2
    shape = parameters[0, 2:].copy().reshape(2, 2)
    return parameters[0, :2].copy(), shape, spread, jacobian, pixels[0] - pixels[35]


def _learnt_plane(
    mean: Array,
    covariance: Array,
    prior_information: Array,
    jacobian: Array,
    predicted: tuple[Array, Array],
    found: tuple[Array, Array],
    kept: float,
) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of a plane after a registration, `kept` [0, 1] of what was known.

    `predicted` and `found` are parameters (6,) and their covariance (6, 6), `jacobian` (6, 3) is their change
    with the mean. Raises numpy's LinAlgError for matrices that are singular to the last digit.
    """
    prior = np.linalg.inv(predicted[1])
    learned = (1.0 - kept) * (np.linalg.inv(found[1]) - prior)
    posterior = np.linalg.inv(prior + learned)
    change = (1.0 - kept) * posterior @ np.linalg.solve(found[1], found[0] - predicted[0])
    gain = covariance @ np.ascontiguousarray(jacobian.T) @ prior
    updated = covariance - gain @ (predicted[1] - posterior) @ np.ascontiguousarray(gain.T)
    information = kept * np.linalg.inv((updated + updated.T) / 2.0) + (1.0 - kept) * prior_information
    loosened = np.linalg.inv(information)
    return mean + gain @ change, (loosened + loosened.T) / 2.0


def _strain_of(shape: Array) -> float:
    """How far a shape (2, 2) is from none: the largest logarithm of stretch, or the turn [rad]."""
    a, b, c, d = shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1]
    even, odd = np.hypot(a + d, c - b) / 2.0, np.hypot(a - d, b + c) / 2.0
    least, most = abs(even - odd), even + odd
    if least <= 1e-6:
        return np.inf
    return float(max(abs(np.log(least)), abs(np.log(most)), abs(np.arctan2(c - b, a + d))))


def _worst_deviation(covariance: Array) -> float:
    """Standard deviation in the worse direction of the first two axes of a covariance (n, n)."""
    a, b, d = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    return float(np.sqrt(max(0.5 * (a + d) + np.hypot(0.5 * (a - d), b), 0.0)))


# No fast arithmetic: the same pixels must give the same bits.
relative: Callable[[Array, Array], tuple[Array, Array]] = compiled(_relative)
directions_of: Callable[[Array, Array, Array, Array, Array], Array] = compiled(_directions_of)
prediction_of: Callable[
    [Array, Array, float, float, float, float], tuple[Array, Array, Array, Array, Array]
] = compiled(_prediction_of)
learnt_plane: Callable[
    [Array, Array, Array, Array, tuple[Array, Array], tuple[Array, Array], float], tuple[Array, Array]
] = compiled(_learnt_plane)
strain_of: Callable[[Array], float] = compiled(_strain_of)
worst_deviation: Callable[[Array], float] = compiled(_worst_deviation)
