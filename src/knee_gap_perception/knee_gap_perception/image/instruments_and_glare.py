"""Detection of instruments and glare by their colour: bright pixels that are not tissue."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask

# Steel returns the lamp's colour, tissue less blue. What the camera calls white is unknown, so warmth, (red -
# blue) / brightest channel, is compared with the picture's own tissue: its coolest fifth, less its spread.
COOLEST = 0.2  # [-] share of lit tissue
LEAST_SPREAD = 0.06  # [-] lower limit of the spread of warmth between the coolest fifth and the median
USUAL_LIMIT = 0.06  # [-] least warmth of tissue in a picture with hardly any that is lit
# Light that passes from tissue to tissue makes a gap warmer than the tissue around it. What is dark and less
# warm than all tissue is a black instrument or a suture.
DARKEST = 20  # [grey levels] below which colour is unreliable
NOISE = 2.0  # [grey levels] of red - blue
WELL_LIT = 90  # [grey levels] from which a pixel counts for the reference
CLIPPED = 250  # [grey levels] from which a channel is clipped, so that colour is unknown
SMALLEST = 3  # [px at working size] smallest side; smaller regions are noise
MARGIN = 2  # [px at working size] of the blurred border around them
GRID = 80  # [px] columns of the reduced picture from which the reference is taken
LEAST_GRID = 40  # [px] of lit tissue in it
# The lamp's mirror image adds white light, so it stands out in the darkest channel too; overexposed tissue
# is as bright, but larger.
GLARE = 225  # [grey levels] least brightness of glare
GLARE_RISE = 50  # [grey levels] by which its darkest channel exceeds the surroundings
GLARE_SIZE = 15  # [px at working size] side of the largest glare


def least_warmth(picture: Image) -> float:
    """Least warmth [-] of tissue in an image (h, w, 3); what is lit and cooler is metal.

    It shifts with white balance as the warmth of every pixel does.
    """
    rows = max(1, round(picture.shape[0] * GRID / picture.shape[1]))
    blue, green, red = cv2.split(cv2.resize(picture, (GRID, rows), interpolation=cv2.INTER_LINEAR))
    value = cv2.max(cv2.max(blue, green), red)
    lit = (value >= WELL_LIT) & (value < CLIPPED)
    warmth = (red[lit].astype(np.float32) - blue[lit]) / value[lit]
    if len(warmth) < LEAST_GRID:
        return USUAL_LIMIT
    places = int(COOLEST * len(warmth)), len(warmth) // 2
    coolest, median = np.partition(warmth, places)[list(places)]
    return float(coolest - max(median - coolest, LEAST_SPREAD))


def foreign_bodies(image: Image, warmth: float) -> Mask:
    """Pixels (h, w) of an image (h, w, 3) at working size that show metal or glare; as `metal_and_glare`."""
    metal, glare = metal_and_glare(image, warmth)
    return metal | glare


def metal_and_glare(image: Image, warmth: float) -> tuple[Mask, Mask]:
    """Pixels (h, w) of an image (h, w, 3) at working size that show metal, and those that show glare.

    `warmth` is the least of tissue in the whole picture (`least_warmth`). In an image without colour (from a
    grey camera) no metal is detected.
    """
    blue, green, red = (np.asarray(channel, np.uint8) for channel in cv2.split(image))
    value = np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)
    glare = np.zeros(value.shape, np.uint8)
    _mark_glare(glare, value, (blue, green, red))
    has_colour = not np.array_equal(blue, red)
    metal = _metal(value, blue, red, warmth) if has_colour else np.zeros(value.shape, np.uint8)
    return _grown(metal), _grown(glare)


def _grown(found: npt.NDArray[np.uint8]) -> Mask:
    """Marked pixels (h, w) without the smallest regions, with the blurred border around the others."""
    if not found.any():
        return found > 0
    opened = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((SMALLEST, SMALLEST), np.uint8))
    return np.asarray(cv2.dilate(opened, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) > 0)


def _mark_glare(found: npt.NDArray[np.uint8], value: Image, channels: tuple[Image, Image, Image]) -> None:
    """Set `found` (h, w) to 1 where brightness `value` (h, w) and the channels (h, w) show glare."""
    if cv2.minMaxLoc(value)[1] < GLARE:
        return
    x, y, width, height = cv2.boundingRect((value >= GLARE).astype(np.uint8))
    # The surroundings of a bright pixel reach half the largest glare beyond the part with such pixels.
    half = GLARE_SIZE // 2 + 1
    part = np.s_[max(0, y - half) : y + height + half, max(0, x - half) : x + width + half]
    blue, green, red = (channel[part] for channel in channels)
    darkest = cv2.min(cv2.min(blue, green), red)
    rise = cv2.morphologyEx(darkest, cv2.MORPH_TOPHAT, np.ones((GLARE_SIZE, GLARE_SIZE), np.uint8))
    found[part] = (value[part] >= GLARE) & (rise >= GLARE_RISE)


def _metal(value: Image, blue: Image, red: Image, warmth: float) -> npt.NDArray[np.uint8]:
    """1 where a pixel (h, w) is lit, not clipped, and less warm than tissue."""
    excess = cv2.addWeighted(red, 1.0, blue, -1.0, 0.0, dtype=cv2.CV_16S)
    least = cv2.addWeighted(value, warmth, value, 0.0, -NOISE, dtype=cv2.CV_16S)
    # Where red is clipped, warmth is unknown; where blue is, it is even less than it seems.
    lit = np.asarray(cv2.max(blue, red)) >= DARKEST
    return np.asarray((excess < least) & lit & (red < CLIPPED), np.uint8)
