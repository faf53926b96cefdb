"""Normal equations of both points and of an offset of each that is common to all images, view by view."""

from typing import NamedTuple

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.likelihood import Linearised
from knee_gap_uncertainty.numerics.small_matrix import cholesky, invert_factored

# Inverse depth while the data do not determine it [1/m]: from 2.5 mm to infinity within two deviations.
EXPECTED_INVERSE_DEPTH = 100.0
INVERSE_DEPTH_DEVIATION = 150.0


class Normal(NamedTuple):
    """Normal equations of both points' a, b, rho and the common offset of each: (10, 10) and (10,)."""

    information: Array
    score: Array


class Scratch(NamedTuple):
    """W A (4, 10) and W r (4,) of one view."""

    weighted: Array
    pull: Array


@compiled
def start_from_prior(out: Linearised, unknowns: Array, normal: Normal) -> None:
    """Start the normal equations with what is known without a view.

    The offset may be as large as all of the error of a bearing.
    """
    normal.information[:, :] = 0.0
    normal.score[:] = 0.0
    count = out.residuals.shape[0]
    for n in range(2):
        strength = 1.0 / INVERSE_DEPTH_DEVIATION**2
        normal.information[3 * n + 2, 3 * n + 2] = strength
        normal.score[3 * n + 2] = strength * (EXPECTED_INVERSE_DEPTH - unknowns[n, 2])
        for k in range(2):
            # Only so that a single view has an inverse.
            normal.information[3 * n + k, 3 * n + k] = 1e-6
        s00, s01, s11 = 0.0, 0.0, 0.0
        for i in range(count):
            s00 += out.image_covariances[i, n, 0, 0] / count
            s01 += out.image_covariances[i, n, 0, 1] / count
            s11 += out.image_covariances[i, n, 1, 1] / count
        det = s00 * s11 - s01 * s01
        row = 6 + 2 * n
        normal.information[row, row] = s11 / det
        normal.information[row + 1, row + 1] = s00 / det
        normal.information[row, row + 1] = -s01 / det
        normal.information[row + 1, row] = -s01 / det


@compiled
def weigh(out: Linearised, i: int, weight: float, scratch: Scratch) -> None:
    """Write W A and W r of a view, A (4, 10) being the derivative of its bearings by all ten unknowns."""
    weighted, pull = scratch.weighted, scratch.pull
    weighted[:, :] = 0.0
    pull[:] = 0.0
    for row in range(4):
        for column in range(4):
            w = weight * out.weights[i, row, column]
            pull[row] += w * out.residuals[i, column]
            weighted[row, 6 + column] = w
            n, axis = column // 2, column % 2
            for k in range(3):
                weighted[row, 3 * n + k] += w * out.jacobians[i, n, axis, k]


@compiled
def add(out: Linearised, i: int, weight: float, scratch: Scratch, normal: Normal) -> None:
    """Add a view, `weight` times, to the normal equations."""
    weigh(out, i, weight, scratch)
    for row in range(4):
        n, axis = row // 2, row % 2
        normal.score[6 + row] += scratch.pull[row]
        for column in range(10):
            normal.information[6 + row, column] += scratch.weighted[row, column]
        for k in range(3):
            slope = out.jacobians[i, n, axis, k]
            normal.score[3 * n + k] += slope * scratch.pull[row]
            for column in range(10):
                normal.information[3 * n + k, column] += slope * scratch.weighted[row, column]


@compiled
def add_sideways(out: Linearised, i: int, weight: float, scratch: Scratch, shifted: Normal) -> None:
    """Add a view to the four rows (4, 10) of the normal equations that belong to both points' a and b."""
    weigh(out, i, weight, scratch)
    for row in range(4):
        n, axis = row // 2, row % 2
        for k in range(2):
            slope = out.jacobians[i, n, axis, k]
            shifted.score[2 * n + k] += slope * scratch.pull[row]
            for column in range(10):
                shifted.information[2 * n + k, column] += slope * scratch.weighted[row, column]


@compiled
def invert(normal: Normal, covariance: Array) -> bool:
    """Write the inverse of the information; false where it has none."""
    factor = np.zeros((10, 10))
    if not cholesky(normal.information, factor):
        return False
    invert_factored(factor, covariance)
    return True
