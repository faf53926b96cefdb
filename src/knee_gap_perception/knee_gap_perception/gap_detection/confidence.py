"""Confidence that a dark part of the image is a gap."""

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.gap_detection.cross_section import Section, section_places

# Logistic regression on sections of simulated knees (levels 0-3, open and closed joints) and of real frames
# with a cleft (a nose) and without one (a laparoscope's), open and closed weighted alike.
CONTRAST_WEIGHT = 6.1  # of its logarithm: a part no darker than its sides is not a gap, however sharp
BLUNT_WEIGHT = 6.1
SHARP_WEIGHT = 4.6
SHADE_WEIGHT = -13.1
UNEVENNESS_WEIGHT = -14.4
SLIT_WEIGHT = 12.3
OFFSET = 7.3
LEAST_CONTRAST = 0.05  # [-] limit: lower values carry no further information
MOST_UNEVEN = 0.45  # [-] limit: bone lit in the depth of a gap makes it more uneven than shade
WIDE = 0.1  # [-] radius of the disc relative to the field's; upper limit
NARROWEST = 0.03  # [-] the same; lower limit
# Distance dims all colours alike; a change of tissue does not. The colour of a part
# that is almost black means nothing.
PIGMENT_WEIGHT = -120.0
SAME_COLOUR = 0.2  # [-] difference of the channels' log ratios that reflections between tissues explain
LIT_GAP = (0.3, 0.45)  # [-] brightness relative to a side from which colour begins to count, counts in full
LEVEL_OFFSET = 5.0  # [grey levels]: so that the noise of black does not count as unevenness


def gap_confidence(
    section: Section,
    field_radius: float,
    light: float,
    image: Image,
    dark: Mask,
    scale: float,
    *,
    pointed_at: bool = False,
) -> float:
    """Confidence [0, 1] that a section through dark pixels (h, w) of an image (h, w, 3) is a gap.

    At an opening, an edge hides the tissue behind it: the gap is evenly dark against the tissue on both sides
    and ends sharply. A crease under a condyle, where the bone turns away from the lamp, can be darker than a
    gap, but both its sides fade into shade: they end slowly and are dark themselves. Either alone occurs at
    gaps too, at an edge that is out of focus or far from the lamp's beam; both together mean a crease.

    A dark organ beside a pale one has sharp edges as well. It reflects less of some colours, whereas a far
    wall of the same tissue is darker in all of them.

    `image` and `dark` are reduced by `scale`; `field_radius` [px] is in the pixels of the section, `light`
    [grey levels] the brightness of fully lit tissue. How even other dark parts are, such as the shade at the
    rim of the field, does not matter.

    Where a person has `pointed_at` it, an organ or a thin instrument is not in question, only a crease:
    colour and width, which tell those apart, do not count.
    """
    part = dark if section.part is None else section.part
    sharper = float(section.sharpness.max())
    lit = min(float(section.levels[1:].max()) / light, 1.0)
    evidence = (
        CONTRAST_WEIGHT * np.log(max(float(section.contrast.min()), LEAST_CONTRAST))
        + BLUNT_WEIGHT * float(section.sharpness.min())
        + SHARP_WEIGHT * sharper
        + SHADE_WEIGHT * (1.0 - sharper) * (1.0 - lit)
        + UNEVENNESS_WEIGHT * min(unevenness(image, part), MOST_UNEVEN)
        + OFFSET
    )
    if not pointed_at:
        evidence += PIGMENT_WEIGHT * pigment(section, image, scale) + SLIT_WEIGHT * np.log(
            np.clip(section.radius / field_radius, NARROWEST, WIDE) / WIDE
        )
    return float(1.0 / (1.0 + np.exp(-evidence)))


def unevenness(image: Image, dark: Mask) -> float:
    """Relative spread (against the mean) of the darkness of dark pixels (h, w) of an image (h, w, 3) [-].

    Darkness is the darker of green and blue, which a far wall that glows red does not change.
    """
    level = np.asarray(cv2.min(image[..., 0], image[..., 1]))[dark].astype(np.float64)
    return float(level.std() / (level.mean() + LEVEL_OFFSET)) if level.size else 0.0


def pigment(section: Section, image: Image, scale: float) -> float:
    """How much the dark part of a section differs in colour, and not only in brightness, from both sides [-].

    `image` (h, w, 3) is reduced by `scale`. The difference counts if the dark part returns much light.
    """
    places = section_places(section, scale)
    gap, *sides = (_colour(image, place, half) + LEVEL_OFFSET for place, half in places)
    ratios = gap / np.stack(sides)
    lit = float(ratios.max(axis=1).min())
    difference = float(np.log(ratios.max(axis=1) / ratios.min(axis=1)).min())
    counts = float(np.clip((lit - LIT_GAP[0]) / (LIT_GAP[1] - LIT_GAP[0]), 0.0, 1.0))
    return counts * max(difference - SAME_COLOUR, 0.0)


def _colour(image: Image, place: Array, half: int) -> Array:
    """Median colour (3,) of the pixels within `half` [px] of a place (2,) in an image (h, w, 3)."""
    column, row = np.rint(place).astype(int)
    patch = image[max(0, row - half) : row + half + 1, max(0, column - half) : column + half + 1]
    return np.asarray(np.median(patch.reshape(-1, 3), axis=0) if patch.size else np.zeros(3))
