"""What a segmentation strategy is."""

from typing import Protocol

from knee_gap_core.values.arrays import Image, Mask


class Segmentation(Protocol):
    """Tells which pixels of an image are dark as the gap is.

    The image (h, w, 3) is blue, green, red, at working size; `field` (h, w) is the part of it that shows
    tissue: inside the field of view, without glare and instruments. Returns the dark pixels (h, w), a
    subset of `field`. Nothing is decided here about which of them are a gap.
    """

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
