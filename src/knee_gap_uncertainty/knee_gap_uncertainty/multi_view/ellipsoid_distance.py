"""Smallest and largest distance of two points over the confidence ellipsoid of their unknowns, compiled.

The ellipsoid is the image of the unit ball: unknowns + factor @ unit, |unit| <= 1, for a lower factor (6, 6)
and the unknowns (2, 3) a, b, rho of both points in their `frames` (2, 3, 3), as in `likelihood`. Each
function writes where it found the extreme: the unit vector (6,), the difference G_1 - G_0 (3,) [m] and its
slope (3, 6) by the unit vector.
"""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.numerics.small_matrix import cholesky, solve_factored

ASCENT_STEPS = 60
DESCENT_STEPS = 30


@compiled
def difference(
    frames: Array, unknowns: Array, factor: Array, unit: Array, apart: Array, slope: Array
) -> bool:
    """Write G_1 - G_0 at unknowns + factor @ unit, and its (3, 6) slope by `unit`; false at infinity."""
    apart[:] = 0.0
    slope[:, :] = 0.0
    place = np.zeros(3)
    for n in range(2):
        sign = 2.0 * n - 1.0
        for k in range(3):
            place[k] = unknowns[n, k]
            for column in range(3 * n + k + 1):
                place[k] += factor[3 * n + k, column] * unit[column]
        rho = place[2]
        if not rho > 1e-6:
            return False
        for k in range(3):
            direction = frames[n, 0, k] + place[0] * frames[n, 1, k] + place[1] * frames[n, 2, k]
            apart[k] += sign * direction / rho
            for column in range(3 * n + 3):
                change = (
                    frames[n, 1, k] * factor[3 * n, column]
                    + frames[n, 2, k] * factor[3 * n + 1, column]
                    - direction / rho * factor[3 * n + 2, column]
                )
                slope[k, column] += sign * change / rho
    return True


@compiled
def largest_distance(
    frames: Array, unknowns: Array, factor: Array, unit: Array, apart: Array, slope: Array
) -> float:
    """Largest distance [m], infinite where the ellipsoid reaches infinity: fixed-point ascent.

    It starts along the present difference and, because a gap of the size of its error can grow to either
    side, along both senses of each axis of space.
    """
    for n in range(2):
        reach = 0.0
        for k in range(3 * n + 3):
            reach += factor[3 * n + 2, k] ** 2
        if not unknowns[n, 2] > np.sqrt(reach):
            return np.inf
    unit[:] = 0.0
    difference(frames, unknowns, factor, unit, apart, slope)
    first_apart, first_slope = apart.copy(), slope.copy()
    best_unit = np.zeros(6)
    best = 0.0
    for first in range(7):
        for k in range(3):
            apart[k] = first_apart[k]
            if first > 0:
                apart[k] = frames[0, (first - 1) // 2, k] * (1.0 if first % 2 == 0 else -1.0)
            for column in range(6):
                slope[k, column] = first_slope[k, column]
        previous = 0.0
        for _ in range(ASCENT_STEPS):
            length = 0.0
            for column in range(6):
                value = 0.0
                for k in range(3):
                    value += slope[k, column] * apart[k]
                unit[column] = value
                length += value * value
            length = np.sqrt(length)
            if not length > 0.0:
                break
            for column in range(6):
                unit[column] /= length
            if not difference(frames, unknowns, factor, unit, apart, slope):
                return np.inf
            distance = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
            if distance > best:
                best = distance
                for column in range(6):
                    best_unit[column] = unit[column]
            if abs(distance - previous) <= 1e-9 * distance:
                break
            previous = distance
    for column in range(6):
        unit[column] = best_unit[column]
    difference(frames, unknowns, factor, unit, apart, slope)
    return float(best)


@compiled
def smallest_distance(
    frames: Array, unknowns: Array, factor: Array, unit: Array, apart: Array, slope: Array
) -> float:
    """Smallest distance [m]: Gauss-Newton of the difference to zero inside the ellipsoid."""
    unit[:] = 0.0
    trial = np.zeros(6)
    target = np.zeros(3)
    if not difference(frames, unknowns, factor, unit, apart, slope):
        return 0.0
    best = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
    for _ in range(DESCENT_STEPS):
        for k in range(3):
            target[k] = -apart[k]
            for column in range(6):
                target[k] += slope[k, column] * unit[column]
        _nearest_inside(slope, target, trial)
        distance = np.inf
        for _ in range(6):
            if difference(frames, unknowns, factor, trial, apart, slope):
                distance = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
            if distance < best:
                break
            for column in range(6):
                trial[column] = 0.5 * (unit[column] + trial[column])
        if not distance < best:
            break
        gained = best - distance
        best = distance
        for column in range(6):
            unit[column] = trial[column]
        if gained <= 1e-9 * best:
            break
    difference(frames, unknowns, factor, unit, apart, slope)
    return float(best)


@compiled
def _nearest_inside(slope: Array, target: Array, unit: Array) -> None:
    """Write the `unit` of length at most 1 whose slope @ unit is nearest to the target (secular equation)."""
    gram = np.zeros((3, 3))
    damped = np.zeros((3, 3))
    factor = np.zeros((3, 3))
    weights = np.zeros(3)
    again = np.zeros(3)
    for row in range(3):
        for column in range(3):
            for k in range(6):
                gram[row, column] += slope[row, k] * slope[column, k]
    trace = gram[0, 0] + gram[1, 1] + gram[2, 2]
    damping = 1e-12 * trace
    for _ in range(40):
        damped[:, :] = gram
        for k in range(3):
            damped[k, k] += damping
        if not cholesky(damped, factor):
            damping = max(10.0 * damping, 1e-9 * trace)
            continue
        solve_factored(factor, target, weights)
        squared = 0.0
        for column in range(6):
            value = 0.0
            for k in range(3):
                value += slope[k, column] * weights[k]
            unit[column] = value
            squared += value * value
        length = np.sqrt(squared)
        if length <= 1.0 + 1e-10:
            return
        # Newton's step on 1 / |unit| - 1, whose graph over the damping is nearly straight.
        solve_factored(factor, weights, again)
        inner = 0.0
        for row in range(3):
            for column in range(3):
                inner += weights[row] * gram[row, column] * again[column]
        damping += (length - 1.0) * squared / max(inner, 1e-300)
    for column in range(6):
        unit[column] /= max(length, 1.0)
