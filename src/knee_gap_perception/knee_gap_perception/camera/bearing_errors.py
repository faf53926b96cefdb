"""Bearing errors due to errors of the intrinsics: a displacement for each independent error."""

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.projection import LensModel

# Threshold relative to the largest normalised variance: less is the remainder of a fixed parameter.
NEGLIGIBLE = 1e-9


class BearingErrors:
    """Independent errors of the intrinsics of one calibration, and their effect on bearings."""

    def __init__(self, camera: Intrinsics) -> None:
        self._model, self._parameters = LensModel(camera.distortion_model), camera.parameters
        # Scaled, because a focal length is in pixels and a distortion is not.
        scale = np.sqrt(np.maximum(np.diag(camera.covariance), 1e-300))
        values, vectors = np.linalg.eigh(camera.covariance / np.outer(scale, scale))
        kept = values > NEGLIGIBLE * max(float(values.max()), 1e-300)
        kept &= (np.abs(vectors) > 1e-6)[scale > 1e-140].any(axis=0)
        self._root = scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])

    def of(self, bearings: Array) -> Array:
        """Displacements (n, 3, k) [rad] of bearings (n, 3) by one standard deviation of each error.

        The pixel is fixed: the bearing moves so as to compensate the shift of its projection.
        """
        seen = self._model.project(bearings, self._parameters)
        moved = seen.by_parameter @ self._root
        return np.asarray(-np.linalg.pinv(seen.by_point) @ moved)
