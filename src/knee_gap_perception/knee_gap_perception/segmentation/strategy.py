"""Interface of a segmentation strategy."""

from typing import Protocol

from knee_gap_core.values.arrays import Image, Mask


class Segmentation(Protocol):
    """Segments the pixels of an image that are as dark as the gap.

    The image (h, w, 3) is blue, green, red, at working size; `field` (h, w) is the part of it that shows
    tissue: inside the field of view, without glare and instruments. Returns the dark pixels (h, w), a
    subset of `field`. Which of them are a gap is decided elsewhere.
    """

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
