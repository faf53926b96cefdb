"""Places of a lens under the error of its tracked position: equations (13)-(16)."""

import math

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_uncertainty.numerics.vectors import Vector

ELEVATION_STEPS = 4
AZIMUTH_STEPS = 6


def directions() -> npt.NDArray[np.float64]:
    """Unit vectors r(az, el) (12, 3) of (15), on the paper's grid of 24 without its repeats.

    Azimuth -pi and pi are one direction, and at the poles every azimuth is.
    """
    elevation, azimuth = np.meshgrid(
        np.linspace(-math.pi / 2, math.pi / 2, ELEVATION_STEPS),
        np.linspace(-math.pi, math.pi, AZIMUTH_STEPS),
        indexing="ij",
    )
    grid = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    _, first = np.unique(grid.round(9) + 0.0, axis=0, return_index=True)
    return np.ascontiguousarray(grid[np.sort(first)])


DIRECTIONS = directions()


def displacements(translation_error: float, radii: int = 1) -> npt.NDArray[np.float64]:
    """Displacements of a lens (radii * 12, 3) [m]: `radii` equal steps up to the error, (13), (14).

    One radius is the outer shell. Without a translation error there is one displacement, zero.
    """
    if translation_error == 0:
        return np.zeros((1, 3))
    steps = translation_error * np.arange(1, radii + 1) / radii
    return (steps[:, None, None] * DIRECTIONS).reshape(-1, 3)


@compiled
def displaced_travel(travel: Vector, start: Vector, end: Vector) -> Vector:
    """Travel t' between displaced lens positions, (16)."""
    return (
        travel[0] + (end[0] - start[0]),
        travel[1] + (end[1] - start[1]),
        travel[2] + (end[2] - start[2]),
    )
