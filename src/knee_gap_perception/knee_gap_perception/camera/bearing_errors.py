"""What errors of the camera's own numbers do to a bearing: a displacement for each independent one."""

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.projection import LensModel

# Of the largest variance, each parameter by its own: what a fit leaves of a parameter that it did not change.
NEGLIGIBLE = 1e-9


class BearingErrors:
    """The independent errors of the intrinsics of one calibration, felt by any bearing."""

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

        The pixel stays: of what the projection of the bearing moves, the bearing has to take back.
        """
        seen = self._model.project(bearings, self._parameters)
        moved = seen.by_parameter @ self._root
        return np.asarray(-np.linalg.pinv(seen.by_point) @ moved)
