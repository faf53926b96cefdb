"""How sure it is that a dark part of the picture is a gap."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_perception.section import Section

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

# Logistic regression on sections of simulated knees (levels 0-3, open and closed joints) and of real frames
# with a cleft (a nose) and without one (a laparoscope's), open and closed weighted alike.
CONTRAST_WEIGHT = 13.7
SHARPNESS_WEIGHT = 14.1
SIZE_WEIGHT = 3.3
UNEVENNESS_WEIGHT = -14.2
OFFSET = -6.5
LEAST_CONTRAST = -0.5  # [-]: what is brighter than its sides by more tells nothing more
LARGEST_SIZE = 0.3  # [-] radius of the disc against the field's, above which more tells nothing more
LEVEL_OFFSET = 5.0  # [grey levels]: the noise of black is no unevenness


def gap_confidence(section: Section, field_radius: float, image: Image, dark: Mask) -> float:
    """Confidence [0, 1] that a section through dark pixels (h, w) of an image (h, w, 3) is a gap.

    A gap is dark against the tissue on both sides, ends sharply, is open and evenly dark. Shaded tissue is a
    little darker than its surroundings, ends slowly, is ragged, so that no large disc fits into it, and
    uneven. `field_radius` [px] is in the pixels of the section.
    """
    evidence = (
        CONTRAST_WEIGHT * max(float(section.contrast.min()), LEAST_CONTRAST)
        + SHARPNESS_WEIGHT * float(section.sharpness.min())
        + SIZE_WEIGHT * min(section.radius / field_radius, LARGEST_SIZE)
        + UNEVENNESS_WEIGHT * unevenness(image, dark)
        + OFFSET
    )
    return float(1.0 / (1.0 + np.exp(-evidence)))


def unevenness(image: Image, dark: Mask) -> float:
    """Spread of the darkness of dark pixels (h, w) of an image (h, w, 3), against its mean [-].

    Darkness is the darker of green and blue, which a far wall that glows red does not change.
    """
    level = np.asarray(cv2.min(image[..., 0], image[..., 1]))[dark].astype(np.float64)
    return float(level.std() / (level.mean() + LEVEL_OFFSET)) if level.size else 0.0
