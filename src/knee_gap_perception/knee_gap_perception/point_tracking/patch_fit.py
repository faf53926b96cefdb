"""Gauss-Newton registration of a patch in one compiled call."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Float32
from knee_gap_perception.point_tracking.patch_kernel import STEP, normal_equations, reweighted, structures

GAIN_PRIOR = 0.3  # [-] standard deviation of the contrast against the patch's
NOISE_CORRELATION = 2.7  # factor on the variance: the residuals of neighbouring pixels are not independent
MAXIMUM_ITERATIONS = 12
CONVERGED = 0.02  # [px]
FINISHING = 2  # iterations in which only gradients count that both textures have
BLOCKS = 3  # a side, for each of which that is decided
CHANCE = 0.1  # [-] share of them, and correlation, that two textures of mere noise have in common
LEAST_LIKENESS = 0.02  # [-] of textures that have nothing in common


@compiled
def likeness(correlation: float) -> float:
    """Share of the information on a shift that counts, of textures that correlate so.

    The noise of both textures makes false gradients, which may lock onto each other. Found on the
    simulated knee, where what registrations add to the error was separated from what grows with the
    parallax: the variance goes as the inverse of the correlation beyond chance.
    """
    return min(max((correlation - CHANCE) / (1.0 - CHANCE), LEAST_LIKENESS), 1.0)


@compiled
def agreed(pixels: Float32, texture: Float32, weight: Float32, matrix: Array) -> Float32:
    """The patch's pixels with their gradients reduced to the part that the image has as well.

    Block by block: with H the structure tensor of the patch and C that of patch and image, a gradient g
    becomes C H^-1 g, with eigenvalues from 0 to 1. The information on a shift is then C H^-1 C, and what
    noise alone pulls to vanishes on the average (instrumental variables).
    """
    own, cross = structures(pixels, texture, weight, matrix, BLOCKS)
    agreement = np.empty((BLOCKS, BLOCKS, 2, 2))
    for i in range(BLOCKS):
        for j in range(BLOCKS):
            regular = 1e-6 * (1.0 + own[i, j, 0, 0] + own[i, j, 1, 1])
            values, vectors = np.linalg.eigh(own[i, j] + regular * np.eye(2))
            turned = np.ascontiguousarray(vectors.T)
            root = (vectors * np.sqrt(values)) @ turned
            inverse = (vectors / np.sqrt(values)) @ turned
            shares, axes = np.linalg.eigh(inverse @ np.ascontiguousarray(cross[i, j]) @ inverse)
            shares = np.minimum(np.maximum((shares - CHANCE) / (1.0 - CHANCE), 0.0), 1.0)
            agreement[i, j] = root @ ((axes * shares) @ np.ascontiguousarray(axes.T)) @ inverse
    return reweighted(pixels, agreement)


@compiled
def placement(position: Array, shape: Array, origin: Array, half: float) -> Array:
    """Matrix (2, 3) from a pixel of the patch (column, row) to one of the crop that starts at `origin`."""
    matrix = np.empty((2, 3))
    for k in range(2):
        matrix[k, 0], matrix[k, 1] = shape[k, 0], shape[k, 1]
        matrix[k, 2] = position[k] - origin[k] - half * (shape[k, 0] + shape[k, 1])
    return matrix


def _fit_patch(
    patch: Float32,
    texture: Float32,
    weight: Float32,
    origin: Array,
    position: Array,
    shape: Array,
    prior: Array,
) -> tuple[Array, Array, Array, float, float, bool]:
    """Find a patch (n, n, 4) in a crop (h, w) that starts at a pixel (2,), from a predicted warp.

    The parameters are position x, y [px] and shape xx, xy, yx, yy [-], with the covariance `prior` (6, 6).
    Returns position (2,), shape (2, 2), covariance (6, 6), correlation, the share of the patch that is seen,
    and whether it converged. Raises numpy's LinAlgError for matrices that are singular to the last digit.
    """
    half = 0.5 * STEP * (patch.shape[0] - 1)  # [px]
    # A step s of the patch changes the warp's parameters by -jacobian s.
    jacobian = np.zeros((6, 6))
    jacobian[:2, :2] = shape
    for i in range(2):
        for j in range(2):
            for k in range(2):
                jacobian[2 + 2 * i + k, 2 + 2 * j + k] = shape[i, j]
    turned = np.ascontiguousarray(jacobian.T)
    prior_information = np.zeros((7, 7))
    prior_information[:6, :6] = turned @ np.linalg.inv(prior) @ jacobian
    prior_information[6, 6] = 1.0 / GAIN_PRIOR**2
    posterior = prior_information
    gain, deviation, converged = 1.0, np.zeros(7), False
    # Where the noise makes gradients, they pull as much as true ones but are false. Near the end the
    # true part of them is known, and only that counts.
    pixels, finishing = patch, 0
    for turn in range(MAXIMUM_ITERATIONS):
        matrix = placement(position, shape, origin, half)
        hessian, slope, statistics = normal_equations(pixels, texture, weight, matrix, gain)
        precision = likeness(statistics[2]) / (NOISE_CORRELATION * statistics[0] ** 2)
        posterior = hessian * precision + prior_information
        step = np.linalg.solve(posterior, slope * precision - prior_information @ deviation)
        deviation += step
        gain = min(max(gain + step[6], 0.3), 3.0)
        # Warp o step^-1, the inverse compositional update; the shape changes by a third at most.
        change = np.eye(2)
        for k in range(4):
            change[k // 2, k % 2] += min(max(step[2 + k], -0.3), 0.3)
        back = shape @ np.linalg.inv(change)
        position = position - back @ step[:2]
        shape = back
        still = np.abs(step[:2]).max() < CONVERGED and np.abs(step[2:6]).max() * half < 5 * CONVERGED
        if finishing == FINISHING or (finishing > 0 and still):
            converged = True
            break
        if finishing > 0 or still or turn >= MAXIMUM_ITERATIONS - 1 - FINISHING:
            finishing += 1
            pixels = agreed(patch, texture, weight, placement(position, shape, origin, half))
    inverse = np.ascontiguousarray(np.linalg.inv(posterior)[:6, :6])
    covariance = jacobian @ inverse @ turned
    matrix = placement(position, shape, origin, half)
    statistics = normal_equations(patch, texture, weight, matrix, gain)[2]
    return position, shape, (covariance + covariance.T) / 2, statistics[2], statistics[1], converged


# No fast arithmetic: the same pixels must give the same bits.
fit_patch: Callable[
    [Float32, Float32, Float32, Array, Array, Array, Array],
    tuple[Array, Array, Array, float, float, bool],
] = compiled(_fit_patch)
