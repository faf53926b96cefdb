"""Points of tissue on simple surfaces, and the free radius around an axis between them."""

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.surfaces.instrument_gap import REACH


def grid(*axes: Array) -> Array:
    """All points (n, k) of a grid with these places along its k axes."""
    points: Array = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return points


def spread(reach: float, spacing: float) -> Array:
    """Places within a reach of 0, a spacing apart."""
    return np.linspace(-reach, reach, round(2.0 * reach / spacing) + 1)


def planes(height: float, angle: float = 0.0) -> Array:
    """Two planes above one another, turned about x by an angle [rad] in the frame of the view along z."""
    flat = grid(spread(6e-3, 0.08e-3), spread(14e-3, 0.08e-3))
    both = [np.stack([flat[:, 0], np.full(len(flat), y), flat[:, 1]], axis=-1) for y in (-height, height)]
    turned: Array = np.concatenate(both) @ Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix().T
    return turned


def free_radius(points: Array, crossing: Array, direction: Array) -> float:
    """Radius [m] of the thickest instrument around an axis between points (n, 3)."""
    away = points - crossing
    along = away @ direction
    near = np.abs(along) <= REACH
    return float(np.linalg.norm(away[near] - along[near, None] * direction, axis=1).min())
