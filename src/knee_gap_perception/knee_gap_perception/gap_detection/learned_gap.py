"""The gap where the project's own network decides: its section, and the confidence in it.

A dark band is not asked for: an opening may be a crescent at the rim with a lit wall behind it. What the
network says of the opening and of the tissue beside it takes the place of brightness.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_perception.gap_detection.cross_section import Section, find_section
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.segmentation.learned import Classes

GAP = 0.5  # [-] probability from which a pixel belongs to the opening
MADE = 0.35  # [-] probability from which a pixel shows an instrument: a point on one is worse than none
GLARE = 0.5  # [-]
SMALLEST = 0.004  # of the field's area: less is not an opening that one can look through
SECTIONS = 4  # that are tried along an opening, where beside the first ones no points can be chosen
WIDER = 1.65  # times the radius of the region of interest: the network judges up to near the rim as well
# The network takes a dark organ beside a pale one for an opening: on its darker side there is hardly a step.
# Both numbers were chosen by looking at sections of pictures that the network had not seen.
CONTRAST_WEIGHT = 4.0  # of the logarithm of the lesser contrast, relative to
USUAL_CONTRAST = 0.3
LEAST_CONTRAST = 0.05  # [-] limit: lower values carry no further information
CERTAIN = 0.999  # [-] upper limit of a pixel's probability


class LearnedGap(NamedTuple):
    """What the network sees: probabilities and masks (h, w) at working size."""

    gap: npt.NDArray[np.float32]
    opening: Mask
    instruments: Mask
    glare: Mask


def learned_gap(classes: Classes, field: Mask, metal_and_glare: tuple[Mask, Mask]) -> LearnedGap:
    """Masks of the opening, of instruments and of glare within a field (h, w).

    `metal_and_glare` (h, w) are those that colour shows; they count as well.
    """
    metal, clipped = metal_and_glare
    made = _grown(field & (classes.instrument > MADE), 2) | (field & metal)
    glare = field & ((classes.glare > GLARE) | clipped)
    opening = field & (classes.gap > GAP) & ~made
    return LearnedGap(classes.gap, _without_specks(opening, SMALLEST * float(field.sum())), made, glare)


def learned_sections(
    seen: LearnedGap, value: Image, field: FieldOfView, scale: float, region: tuple[Array, float]
) -> Iterator[tuple[Section, float]]:
    """Sections through the opening, the best first, and the confidence [0, 1] in each.

    `value` (h, w) is the brightness at working size, `scale` times the full size; `region` as for
    `find_section`. Each is sought when it is asked for, apart from those before it.
    """
    taken: Mask = np.zeros(seen.opening.shape, bool)
    for _ in range(SECTIONS):
        apart = taken if taken.any() else None
        section = find_section(seen.opening, value, seen.instruments, field, scale, region, apart)
        if section is None:
            return
        yield section, section_confidence(seen.gap, section, scale)
        taken = taken | _disc(taken.shape, (section.centre + 0.5) * scale - 0.5, 2.0)


def section_confidence(gap: npt.NDArray[np.float32], section: Section, scale: float) -> float:
    """Confidence [0, 1] in a section, from the probabilities (h, w) in its disc and its lesser contrast."""
    disc = _disc(gap.shape, (section.centre + 0.5) * scale - 0.5, max(section.radius * scale, 1.0))
    share = np.clip(gap[disc], 1.0 - CERTAIN, CERTAIN)
    odds = float(np.log(share / (1.0 - share)).mean())
    contrast = max(float(section.contrast.min()), LEAST_CONTRAST)
    odds += CONTRAST_WEIGHT * float(np.log(contrast / USUAL_CONTRAST))
    return float(1.0 / (1.0 + np.exp(-odds)))


def _disc(shape: tuple[int, ...], centre: Array, radius: float) -> Mask:
    """Pixels of an image of a shape within a radius [px] of a pixel (2,)."""
    rows, columns = np.ogrid[0 : shape[0], 0 : shape[1]]
    return np.asarray((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 <= radius**2)


def _without_specks(mask: Mask, least: float) -> Mask:
    """A mask (h, w) without its parts of fewer than `least` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[labels] if count > 1 else np.zeros_like(mask))


def _grown(mask: Mask, margin: int) -> Mask:
    side = 2 * margin + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)
