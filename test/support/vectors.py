"""Vectors, for tests."""

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array


def unit(vectors: npt.ArrayLike) -> Array:
    """Return the vectors (..., 3) at length 1."""
    given = np.asarray(vectors, dtype=float)
    return np.asarray(given / np.linalg.norm(given, axis=-1, keepdims=True))
