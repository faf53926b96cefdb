"""Texture at the places of a piece of tissue, by which a point can be followed."""

import numpy as np

from knee_gap_core.values.arrays import Array, Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.point_tracking.patch_fit import BLOCKS
from knee_gap_perception.point_tracking.patch_kernel import block_tensors
from knee_gap_perception.point_tracking.patch_registration import (
    LOCAL_MEAN,
    gradients,
    patch_window,
    surface_around,
)

# [px] around what is judged: the local mean must have tissue on all sides there as well.
MARGIN = LOCAL_MEAN // 2 + 4
STEP = 2  # [px] between the pixels that are looked at


class TissueTexture:
    """Texture of the square around a pixel, taken once for all places that are judged in it.

    A place is judged by how well a patch around it measures a shift, much as `Patch` would take it;
    but highlights are found by the light of the whole square.
    """

    def __init__(self, grey: Image, centre: Array, reach: float, half_size: int, dark_below: float) -> None:
        """Take what is within `reach` [px] of a pixel (2,) of an image (h, w), for patches of a half size.

        Grey levels below `dark_below` are not tissue.
        """
        surface = surface_around(grey, centre, int(np.ceil(reach)) + half_size + MARGIN, dark_below)
        self._dx, self._dy = gradients(surface.texture)
        self._surface, self._half_size = surface, half_size
        # Neighbours are nearly the same.
        self._window = np.ascontiguousarray(patch_window(half_size)[::STEP, ::STEP])

    def information(self, pixel: Array, limit: float = float("inf")) -> tuple[Array, float]:
        """Structure tensor (2, 2) [1/px^2] at a pixel (2,), and the share of the patch there that is tissue.

        Only every other pixel of every other line is summed up. Of a block of the patch it takes no more than
        `limit` times that of the median block. Raises PerceptionError for a pixel outside the square.
        """
        corner = np.rint(pixel - np.array(self._surface.origin)) - self._half_size
        last = self._surface.weight.shape[0] - (2 * self._half_size + 1)
        if not ((corner >= 0) & (corner <= last)).all():
            raise PerceptionError(f"the pixel {pixel} lies outside the square that was taken")
        column, row = corner.astype(int)
        blocks, weight = block_tensors(
            self._dx, self._dy, self._surface.weight, self._window, (int(row), int(column)), STEP, BLOCKS
        )
        amounts = blocks[:, 0] + blocks[:, 2]
        if np.isfinite(limit):
            blocks *= np.minimum(1.0, limit * np.median(amounts) / np.maximum(amounts, 1e-9))[:, None]
        total = blocks.sum(axis=0)
        return total[[0, 1, 1, 2]].reshape(2, 2), weight / float(self._window.sum())
