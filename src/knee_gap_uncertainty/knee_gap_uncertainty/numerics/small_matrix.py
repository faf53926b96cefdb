"""Cholesky factors of small symmetric matrices, compiled: a LAPACK call costs more than these sums."""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array


@compiled
def cholesky(matrix: Array, factor: Array) -> bool:
    """Write the lower factor of a symmetric (n, n) matrix; false where it is not positive definite."""
    n = matrix.shape[0]
    for column in range(n):
        pivot = matrix[column, column]
        for k in range(column):
            pivot -= factor[column, k] * factor[column, k]
        if not pivot > 0.0:
            return False
        root = np.sqrt(pivot)
        factor[column, column] = root
        for row in range(column + 1, n):
            rest = matrix[row, column]
            for k in range(column):
                rest -= factor[row, k] * factor[column, k]
            factor[row, column] = rest / root
            factor[column, row] = 0.0
    return True


@compiled
def solve_factored(factor: Array, right: Array, solution: Array) -> None:
    """Write the solution of L L^T x = right, for a lower factor L."""
    n = factor.shape[0]
    for row in range(n):
        rest = right[row]
        for k in range(row):
            rest -= factor[row, k] * solution[k]
        solution[row] = rest / factor[row, row]
    for row in range(n - 1, -1, -1):
        rest = solution[row]
        for k in range(row + 1, n):
            rest -= factor[k, row] * solution[k]
        solution[row] = rest / factor[row, row]


@compiled
def invert_factored(factor: Array, inverse: Array) -> None:
    """Write (L L^T)^-1 for a lower factor L."""
    n = factor.shape[0]
    unit = np.zeros(n)
    column = np.zeros(n)
    for k in range(n):
        unit[k] = 1.0
        solve_factored(factor, unit, column)
        for row in range(n):
            inverse[row, k] = column[row]
        unit[k] = 0.0
