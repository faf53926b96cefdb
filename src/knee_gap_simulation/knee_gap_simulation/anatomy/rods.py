"""Rays against the rods of an instrument, before whatever tissue they meet."""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.surfaces.distance_field import probe_distance

_CLOSE = 1e-7
_MOST_STEPS = 200


@compiled(nogil=True)
def rod_hits(
    origin: Array, directions: Array, limits: Array, rods: Array, lengths: Array, normals: Array
) -> None:
    """Lengths (n,) to the rods within limits (n,), left as they are where none is met, and normals (n, 3)."""
    h = 1e-6
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i]
        if not np.isfinite(dx):
            continue
        t = 0.0
        for _ in range(_MOST_STEPS):
            x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            distance = probe_distance(x, y, z, rods)
            if distance < _CLOSE:
                lengths[i] = t
                normals[i, 0] = probe_distance(x + h, y, z, rods) - probe_distance(x - h, y, z, rods)
                normals[i, 1] = probe_distance(x, y + h, z, rods) - probe_distance(x, y - h, z, rods)
                normals[i, 2] = probe_distance(x, y, z + h, rods) - probe_distance(x, y, z - h, rods)
                break
            t += distance
            if t > limits[i]:
                break
