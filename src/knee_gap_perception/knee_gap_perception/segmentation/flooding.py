"""Segmentation by scikit-image's watershed, flooded from markers of certain gap and certain tissue."""

import cv2
import numpy as np
from skimage.segmentation import watershed

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.segmentation.even_light import even_light, log_levels

GAP, TISSUE = 1, 2


class Watershed:
    """Floods the gradient of brightness from pixels that are certainly gap or certainly tissue.

    A pixel is certain if it is well away from the threshold between the dark and the middle of three classes;
    tissue starts well inside the middle class only. The reason: shaded bone behind a rim belongs to the gap,
    and the step at the rim is higher than the one behind it. In between, the border is where brightness
    changes fastest, whatever its level. A veil of fluid or a shaded flank shifts the level, not the step.
    """

    MARGIN = 24.0  # [levels of the logarithm] on either side of the threshold: no pixel is certain there
    SURE_TISSUE = 0.6  # [-] of the middle class, below which no pixel is certain
    GRADIENT_OFFSET = 64.0  # [grey levels]: steps are weighted by brightness more than by its logarithm

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        if not field.any():
            return field.copy()
        smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)
        level, dark, middle = even_light(smooth, field)
        steps = log_levels(smooth, self.GRADIENT_OFFSET)
        gradient = np.hypot(cv2.Sobel(steps, cv2.CV_32F, 1, 0), cv2.Sobel(steps, cv2.CV_32F, 0, 1))
        # Half of the dark class is certain in any case, since it may be narrower than the margin.
        sure_gap = max(dark - self.MARGIN, float(np.median(level[field & (level <= dark)])))
        markers = np.zeros(field.shape, np.int32)
        markers[field & (level <= sure_gap)] = GAP
        markers[field & (level > dark + max(self.MARGIN, self.SURE_TISSUE * (middle - dark)))] = TISSUE
        # Only the uncertain pixels, and the neighbours from which they are flooded, are processed.
        unsure = (field & (markers == 0)).astype(np.uint8)
        part = field & (cv2.dilate(unsure, np.ones((3, 3), np.uint8)) > 0)
        flooded = watershed(gradient, np.where(part, markers, 0), mask=part)  # type: ignore[no-untyped-call]
        return np.asarray((flooded == GAP) | (markers == GAP))
