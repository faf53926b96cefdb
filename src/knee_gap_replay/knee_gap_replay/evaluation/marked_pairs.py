"""Pairs of a predicted gap mask and one marked by hand in a real picture."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.marks.marked_picture import Decision, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import read_marks
from knee_gap_perception.marks.picture_files import marked_images
from knee_gap_replay.evaluation.pairs import Pair, mask_files, read_mask


def is_marks(path: Path | None) -> bool:
    """Whether a path is a file of marks."""
    return path is not None and path.suffix == ".json"


def mask_name(picture: MarkedPicture) -> str:
    """Name of a picture's predicted mask without suffix: `knee`, or `knee_00012` for frame 12 of a video."""
    stem = Path(picture.file).stem
    return stem if picture.frame is None else f"{stem}_{picture.frame:05d}"


def marked_pairs(
    predicted: Path, marks: Path, pictures: Path | None, segmentation: str | None
) -> tuple[int, Iterator[Pair]]:
    """Pairs for the pictures of a file of marks; those whose decision is unclear are left out.

    With a folder of pictures, `predicted` holds masks with the names of `mask_name`. Without one it holds the
    pictures, which are segmented here as in segmentation_node. Where the marks are unclear, both masks are
    empty. Raises PerceptionError for marks of other pictures and for a mask of another size.
    """
    known = [picture for picture in read_marks(marks) if picture.decision is not Decision.UNCLEAR]
    masks: dict[Path, Path] | None = None
    if pictures is not None:
        masks = mask_files(predicted)
        with_mask = [picture for picture in known if Path(mask_name(picture)) in masks]
        if not with_mask:
            raise PerceptionError(f"no mask in {predicted} has the name of a picture in {marks}")
        if missing := len(known) - len(with_mask):
            print(f"evaluate: {missing} marked pictures without a mask are skipped", file=sys.stderr)
        known = with_mask
    parameters = EdgeParameters()
    parameters = replace(parameters, segmentation=segmentation or parameters.segmentation)

    def mask_of(picture: MarkedPicture, image: Image) -> Mask:
        if masks is None:
            return GapEdgeTracker(parameters).gap_mask(image) > 0
        path = masks[Path(mask_name(picture))]
        mask = read_mask(path)
        if mask.shape != picture.shape:
            raise PerceptionError(
                f"{path} has {mask.shape[1]}x{mask.shape[0]} px, "
                f"{picture.name} was marked with {picture.width}x{picture.height} px"
            )
        return mask

    def pairs() -> Iterator[Pair]:
        for picture, image in marked_images(known, predicted if pictures is None else pictures):
            scored = picture.scored()
            mask, gap = mask_of(picture, image) & scored, picture.mask(Region.GAP) & scored
            yield Pair(picture.source, mask_name(picture), mask, gap, image)

    return len(known), pairs()
