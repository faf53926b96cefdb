"""Segmentation by the active contour of Chan and Vese, from scikit-image."""

import numpy as np
from skimage.segmentation import morphological_chan_vese

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.segmentation.even_light import even_light


class ChanVese:
    """A contour that divides the image into two parts of even brightness, started from a threshold."""

    def __init__(self, iterations: int = 12, smoothing: int = 1) -> None:
        """`iterations` of the contour, with this number of smoothing steps in each."""
        self._iterations, self._smoothing = iterations, smoothing

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        evened, dark, _ = even_light(image, field)
        start = field & (evened <= dark)
        # Lit tissue spans several times the range of the gap; clipping it leaves two even parts. Outside the
        # field the level is that of lit tissue, so that no contour forms on the rim.
        lit = float(np.percentile(evened[field], 50))
        level = np.minimum(evened, lit).astype(np.float64)
        level[~field] = lit
        grown = morphological_chan_vese(  # type: ignore[no-untyped-call]
            level, self._iterations, init_level_set=start.astype(np.int8), smoothing=self._smoothing
        )
        return np.asarray(field & (grown == 1))
