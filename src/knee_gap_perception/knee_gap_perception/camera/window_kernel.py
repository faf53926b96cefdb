"""Refraction at a flat window, compiled: bearings are asked for many times an image."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array


def _refracted_rays(rays: Array, index_ratio: float) -> Array:
    """Unit vectors (n, 3) behind the window of rays (n, 3) before it; as `models.refracted`."""
    refracted = np.full(rays.shape, np.nan)
    for i in range(rays.shape[0]):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if not (length > 0.0 and z > 0.0):
            continue
        x, y = index_ratio * x / length, index_ratio * y / length
        square = 1.0 - (x * x + y * y)
        if square > 0.0:
            refracted[i, 0], refracted[i, 1], refracted[i, 2] = x, y, np.sqrt(square)
    return refracted


refracted_rays: Callable[[Array, float], Array] = compiled(_refracted_rays)
