"""Segmentation by the project's own network, trained on renders and on marked pictures.

Its weights are part of the package (`learned.onnx`); `docs/how/learned_segmentation.md` says what they were
trained on, and how. Beside the gap it knows instruments and glare.
"""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_core.values.pixel_classes import PixelClass
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.network_input import (
    CHANNELS,
    SIDE,
    cut_out,
    network_input,
    square_around,
)

WEIGHTS = Path(__file__).with_name("learned.onnx")


class Classes(NamedTuple):
    """Probabilities [0, 1] of what each pixel (h, w) shows; 0 outside the field."""

    gap: npt.NDArray[np.float32]
    instrument: npt.NDArray[np.float32]
    glare: npt.NDArray[np.float32]


class Learned:
    """The project's own network. Raises PerceptionError if its weights are missing or of another shape."""

    def __init__(self, path: str = "") -> None:
        """`path` of other weights of the same shape; by default those of the package."""
        self._path = Path(path) if path else WEIGHTS
        if not self._path.is_file():
            raise PerceptionError(f"network_path must be an ONNX file; '{self._path}' is not a file")
        try:
            self._net = cv2.dnn.readNetFromONNX(str(self._path))
        except cv2.error as error:
            why = " ".join(error.err.split())
            raise PerceptionError(f"OpenCV cannot read the network '{self._path}': {why}") from error
        self._check()

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Pixels (h, w) of an image (h, w, 3) within `field` (h, w) that show the gap."""
        return np.asarray(field & (self.classes(image, field).gap > 0.5))

    def classes(self, image: Image, field: Mask) -> Classes:
        """Probabilities of the classes in an image (h, w, 3) with a field of view (h, w)."""
        if not field.any():
            nothing = np.zeros(field.shape, np.float32)
            return Classes(nothing, nothing, nothing)
        square = square_around(field)
        side = (SIDE, SIDE)
        small = np.asarray(cv2.resize(cut_out(image, square), side, interpolation=cv2.INTER_AREA), np.uint8)
        inside = cut_out(field.astype(np.uint8), square)
        small_field = cv2.resize(inside, side, interpolation=cv2.INTER_NEAREST) > 0
        output = self._forward(network_input(small, small_field)[None])[0]
        share = np.exp(output - output.max(axis=0))
        share /= share.sum(axis=0)
        return Classes(
            *(
                _placed(share[which], square, field)
                for which in (PixelClass.GAP, PixelClass.INSTRUMENT, PixelClass.GLARE)
            )
        )

    def _forward(self, channels: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        self._net.setInput(channels)
        return np.asarray(self._net.forward(), np.float32)

    def _check(self) -> None:
        """Refuse weights that take or give something else, at the start and not at an image."""
        shape: tuple[int, ...] = ()
        with suppress(cv2.error):
            shape = self._forward(np.zeros((1, CHANNELS, SIDE, SIDE), np.float32)).shape
        classes = len(PixelClass)
        if len(shape) != 4 or shape[:2] != (1, classes) or shape[2] != shape[3] or shape[2] < 16:
            gives = f"its output is {shape}" if shape else "it does not take this input"
            raise PerceptionError(
                f"the network '{self._path}' is not one of the segmentation 'learned', which turns "
                f"(1, {CHANNELS}, {SIDE}, {SIDE}) into (1, {classes}, n, n): {gives}"
            )


def _placed(
    share: npt.NDArray[np.float32], square: tuple[int, int, int], field: Mask
) -> npt.NDArray[np.float32]:
    """A class's probability at the square's place in the image, 0 outside the field (h, w)."""
    x, y, side = square
    large = cv2.resize(share, (side, side), interpolation=cv2.INTER_LINEAR)
    placed = np.zeros(field.shape, np.float32)
    height, width = field.shape
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + side, width), min(y + side, height)
    placed[y0:y1, x0:x1] = large[y0 - y : y1 - y, x0 - x : x1 - x]
    return np.where(field, placed, np.float32(0.0))
