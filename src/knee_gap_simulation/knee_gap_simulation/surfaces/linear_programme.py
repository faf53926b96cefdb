"""A small linear programme by the simplex method: a compiled kernel."""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array


@compiled(nogil=True)
def highest(rows: Array, limits: Array) -> Array:
    """The x (4,) with the greatest x[3] of all with rows @ x <= limits, (m, 4) and (m,).

    The first six rows must be the upper and the lower bounds of x[0] to x[2], the seventh must bound x[3].
    The dual programme by the simplex method; a basis is four rows, which meet in x.
    """
    basis = np.array([0, 1, 2, 6])
    inverse = np.eye(4)  # of the rows of the basis
    for k in range(3):
        # The bound against which the seventh row pushes.
        if rows[6, k] > 0.0:
            basis[k] = 3 + k
            inverse[k, k] = -1.0
        inverse[3, k] = -rows[6, k] * inverse[k, k]
    x, change = np.zeros(4), np.zeros(4)
    for _ in range(400):
        for j in range(4):
            x[j] = 0.0
            for k in range(4):
                x[j] += inverse[j, k] * limits[basis[k]]
        entering, worst = -1, -1e-9
        for i in range(rows.shape[0]):
            room = limits[i]
            for k in range(4):
                room -= rows[i, k] * x[k]
            if room < worst:
                entering, worst = i, room
        if entering < 0:
            break
        leaving, least = -1, np.inf
        for k in range(4):
            change[k] = 0.0
            for j in range(4):
                change[k] += inverse[j, k] * rows[entering, j]
            if change[k] > 1e-12 and inverse[3, k] / change[k] < least:
                leaving, least = k, inverse[3, k] / change[k]
        if leaving < 0:
            break
        basis[leaving] = entering
        for j in range(4):
            inverse[j, leaving] /= change[leaving]
            for k in range(4):
                if k != leaving:
                    inverse[j, k] -= inverse[j, leaving] * change[k]
    return x
