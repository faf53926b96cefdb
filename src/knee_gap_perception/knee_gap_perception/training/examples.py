"""Examples to train on: square pictures with the class of each pixel, rendered or marked by hand."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from knee_gap_core.user_files import shown
from knee_gap_core.values.arrays import Image, Mask
from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marked_picture import MarkedPicture, Region
from knee_gap_perception.marks.marks_file import read_marks
from knee_gap_perception.marks.picture_files import marked_images, read_picture
from knee_gap_perception.segmentation.network_input import Square, cut_out, square_around

STORED_SIDE = 192  # [px] of a stored example: larger than the network's input, to turn and zoom it
RENDERED = "renders"  # the source of all that this project rendered
_LABELS = ((Region.GLARE, PixelClass.GLARE), (Region.GAP, PixelClass.GAP))
_ON_TOP = (
    (Region.INSTRUMENT, int(PixelClass.INSTRUMENT)),
    (Region.DRAWN, int(PixelClass.INSTRUMENT)),
    (Region.UNCLEAR, UNKNOWN_CLASS),
)


@dataclass(frozen=True)
class Example:
    """A picture (side, side, 3) around its field, and the class of each pixel (side, side).

    `source` names where it comes from; `sha256` is that of the file, empty for a render.
    """

    name: str
    source: str
    image: Image
    labels: Image
    sha256: str = ""

    @property
    def field(self) -> Mask:
        """Pixels (side, side) inside the field of view."""
        return np.asarray(self.labels != PixelClass.OUTSIDE)

    def shows(self, which: PixelClass) -> bool:
        """Whether any pixel is of a class."""
        return bool((self.labels == which).any())


def read_renders(folder: Path) -> list[Example]:
    """Rendered examples of a folder, as `render_examples` writes them.

    Raises PerceptionError if there are none, or one without labels.
    """
    if not folder.is_dir():
        raise PerceptionError(f"{shown(folder)} is not a folder")
    found = []
    for path in sorted(folder.glob("*.jpg")):
        labels = read_picture(path.with_suffix(".png"))[..., 0]
        image = read_picture(path)
        if labels.shape != image.shape[:2]:
            raise PerceptionError(f"{shown(path)} and its labels differ in size")
        if (labels != PixelClass.OUTSIDE).any():
            found.append(_example(path.stem, RENDERED, image, labels))
    if not found:
        raise PerceptionError(f"{shown(folder)} holds no rendered examples: make them with render_examples")
    return found


def read_marked(files: Iterable[Path], pictures: Path) -> list[Example]:
    """Marked pictures of files of marks, each from the folder of its name.

    Raises PerceptionError for a folder or a picture that is missing or another one.
    """
    found = []
    for file in files:
        for picture, image in marked_images(read_marks(file), pictures / file.stem):
            found.append(_example(picture.name, picture.source, image, labels_of(picture), picture.sha256))
    return found


def labels_of(picture: MarkedPicture) -> Image:
    """The class of each pixel (h, w) of a marked picture; what is marked as unclear is unknown."""
    labels = np.full(picture.shape, PixelClass.TISSUE, np.uint8)
    for region, which in _LABELS:
        labels[picture.mask(region)] = which
    for region, value in _ON_TOP:
        labels[picture.mask(region)] = value
    if picture.field is not None:
        labels[~picture.field.mask(picture.shape)] = PixelClass.OUTSIDE
    return labels


def sources_of(examples: Sequence[Example]) -> list[str]:
    """Names of the sources, in the order of their first example."""
    return list(dict.fromkeys(example.source for example in examples))


def _example(name: str, source: str, image: Image, labels: Image, sha256: str = "") -> Example:
    square = square_around(labels != PixelClass.OUTSIDE)
    return Example(name, source, _resized(image, square), _resized(labels, square, labels=True), sha256)


def _resized(image: Image, square: Square, *, labels: bool = False) -> Image:
    side = (STORED_SIDE, STORED_SIDE)
    how = cv2.INTER_NEAREST if labels else cv2.INTER_AREA if square.side > STORED_SIDE else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(cut_out(image, square), side, interpolation=how), np.uint8)
