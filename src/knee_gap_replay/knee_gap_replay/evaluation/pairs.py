"""Pairs of a predicted and a true gap mask, from folders or from recorded bags.

The ground truth of a bag is a topic of masks, or the scene of a simulated bag.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.user_files import FileError, read_bytes, shown
from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.calibrate.bag_input import CalibrationBag
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_simulation.recordings.bag_truth import gap_masks

MaskAt = Callable[[int], Mask | None]

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
SHEET_ROWS = 8
MOST_PICTURE_BYTES = 256 << 20


class Pair(NamedTuple):
    """A predicted and a marked mask (h, w), the names of their set and image, and the image if known."""

    image_set: str
    name: str
    predicted: Mask
    marked: Mask
    picture: Image | None


class BagTopics(NamedTuple):
    """Topics of a bag's images, predicted masks and true masks."""

    image: str
    mask: str
    truth: str


def is_bag(path: Path) -> bool:
    """Whether a path is a recorded bag, not a folder of pictures."""
    return path.suffix == ".mcap" or (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def folder_pairs(predicted: Path, marked: Path, pictures: Path | None) -> tuple[int, Iterator[Pair]]:
    """Pairs of masks of two folders with the same name apart from the suffix; each subfolder is a set.

    Raises PerceptionError if a folder is missing, if no name is in both, or if a file is not an image.
    """
    predictions, marks = mask_files(predicted), mask_files(marked)
    views = mask_files(pictures) if pictures else {}
    names = sorted(predictions.keys() & marks.keys())
    if not names:
        raise PerceptionError(f"no mask in {predicted} has the name of one in {marked}")
    if unpaired := len(predictions.keys() ^ marks.keys()):
        print(f"evaluate: {unpaired} masks without a partner of that name are skipped", file=sys.stderr)

    def pairs() -> Iterator[Pair]:
        for name in names:
            view = _image(views[name]) if name in views else None
            folder = name.parent.as_posix()
            label = "all" if folder == "." else folder
            yield Pair(label, name.name, read_mask(predictions[name]), read_mask(marks[name]), view)

    return len(names), pairs()


def bag_pairs(
    predicted: Path, truth: Path, topics: BagTopics, segmentation: str | None, every: int
) -> tuple[int, Iterator[Pair]]:
    """Pairs of masks of a bag and the ground truth of another, or of itself, with the same stamp.

    `every` is the step between images. The predicted masks are those recorded in the bag. If there are none,
    or if a segmentation is named, its images are segmented here as in segmentation_node. Raises
    PerceptionError for topics that are not in the bag and for a bag without ground truth.
    """
    bag, marked = CalibrationBag(predicted), truth_of(truth, topics.truth)
    recorded = segmentation is None and bag.has(topics.mask)
    stamps = bag.image_stamps(topics.mask if recorded else topics.image)[::every]
    wanted = {int(stamp) for stamp in stamps}

    def predictions() -> Iterator[tuple[int, Mask, Image | None]]:
        if recorded:
            views = _first_pictures(CalibrationBag(truth), topics.image, wanted)
            for stamp, image in bag.images(topics.mask):
                if stamp in wanted:
                    yield stamp, image[..., 0] > 127, views.get(stamp)
            return
        parameters = EdgeParameters()
        detector = GapEdgeTracker(replace(parameters, segmentation=segmentation or parameters.segmentation))
        for stamp, image in bag.images(topics.image):
            if stamp in wanted:
                yield stamp, detector.gap_mask(image) > 0, image

    def pairs() -> Iterator[Pair]:
        for stamp, mask, picture in predictions():
            if (true := marked(stamp)) is not None:
                yield Pair(predicted.stem, str(stamp), mask, true, picture)

    return len(wanted), pairs()


def truth_of(bag: Path, topic: str) -> MaskAt:
    """True mask at a stamp [ns], None if there is none. Raises PerceptionError for a bag without any."""
    source = CalibrationBag(bag)
    if source.has(topic):
        packed = {s: (np.packbits(image[..., 0] > 127), image.shape[:2]) for s, image in source.images(topic)}

        def recorded(stamp: int) -> Mask | None:
            if stamp not in packed:
                return None
            bits, (height, width) = packed[stamp]
            return np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)

        return recorded
    if (masks := gap_masks(bag)) is not None:
        return masks
    raise PerceptionError(f"{bag} has no ground truth: it has no topic {topic}, and it is not simulated")


def _first_pictures(bag: CalibrationBag, topic: str, wanted: set[int]) -> dict[int, Image]:
    """Images for the sheet by stamp; empty if the bag has none."""
    if not bag.has(topic):
        return {}
    return dict(islice(((s, image) for s, image in bag.images(topic) if s in wanted), SHEET_ROWS))


def mask_files(folder: Path) -> dict[Path, Path]:
    """Images of a folder by their path in it without suffix. Raises PerceptionError if it is not one."""
    if not folder.is_dir():
        raise PerceptionError(f"{shown(folder)} is not a folder")
    return {
        path.relative_to(folder).with_suffix(""): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in SUFFIXES
    }


def _image(path: Path) -> Image:
    try:
        data = np.frombuffer(read_bytes(path, MOST_PICTURE_BYTES), dtype=np.uint8)
    except FileError as error:
        raise PerceptionError(str(error)) from None
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise PerceptionError(f"{path} cannot be read as an image")
    return np.asarray(image, dtype=np.uint8)


def read_mask(path: Path) -> Mask:
    """Mask of the gap: pixels brighter than half, or equal to 1 in masks of 0 and 1.

    Raises PerceptionError if it cannot be read.
    """
    image = _image(path).max(axis=2)
    return np.asarray(image > (0 if image.max() <= 1 else 127))
