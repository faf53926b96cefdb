"""Scores of the perception on one marked picture: opening, points, field of view, notch."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.evaluation.image_error import overlap
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.image.field_of_view import FieldOfView, find_field_of_view
from knee_gap_perception.marks.marked_picture import Decision, MarkedField, MarkedPicture, Region
from knee_gap_perception.scope_rotation.notch import find_notch

SAME_FIELD = 0.95  # [-] intersection over union from which a field of view is the marked one
SAME_NOTCH = np.radians(3.0)  # within which a notch is the marked one
BESIDE = 0.01  # of the image's smaller side, by which a section's middle may miss the marked gap


@dataclass(frozen=True)
class PictureScore:
    """What was found in a marked picture, against its marks.

    `found` and `false` are whether two points were chosen across the marked gap, or elsewhere; in a place or
    a picture marked as unclear neither. `on_instrument` counts points on an instrument or a drawn label.
    `dice` is that of the mask on scored pixels, NaN without a marked gap. `field_overlap` is the intersection
    over union with the marked field, 0 if none was found; `rim_error` the 95th percentile of the distance of
    the marked rim from the found one, in its radii. Both are NaN if nothing is marked. `notch_marked` is
    whether a notch is marked; `notch_error` [rad] is NaN unless one is found in such a picture; `notch_false`
    is that one is found where none is marked. `reason` is why no points were chosen.
    """

    name: str
    source: str
    kind: str
    decision: Decision
    found: bool
    false: bool
    on_instrument: int
    confidence: float
    dice: float
    field_overlap: float
    rim_error: float
    notch_marked: bool
    notch_error: float
    notch_false: bool
    reason: str

    @property
    def field_right(self) -> bool:
        """Whether the field of view is the marked one."""
        return self.field_overlap >= SAME_FIELD

    @property
    def notch_seen(self) -> bool:
        """Whether the marked notch is found."""
        return bool(abs(self.notch_error) <= SAME_NOTCH)


def camera_for(image: Image) -> FisheyeCamera:
    """A camera of a usual scope: what is scored in pixels hardly depends on it."""
    height, width = image.shape[:2]
    return FisheyeCamera(width, height, 0.6 * height, 0.6 * height, width / 2, height / 2)


def score_picture(
    picture: MarkedPicture, image: Image, parameters: EdgeParameters | None = None
) -> tuple[PictureScore, Array | None]:
    """Scores of an image (h, w, 3) by itself, and the two points (2, 2) [px] if any were chosen."""
    tracker = GapEdgeTracker(parameters)
    edges = tracker.process(0, image, camera_for(image))
    points = np.asarray(edges.pixels) if edges.status is EdgeStatus.VALID else None
    found, false, on_instrument = _judged(picture, points)
    marked_gap, scored = picture.mask(Region.GAP), picture.scored()
    dice = nan
    if picture.decision is Decision.GAP:
        dice = overlap((tracker.gap_mask() > 0) & scored, marked_gap & scored).dice
    field = find_field_of_view(image)
    notch = find_notch(image, field) if field is not None else None
    notch_error = nan
    if picture.notch is not None and notch is not None:
        notch_error = float((notch.angle - picture.notch + np.pi) % (2 * np.pi) - np.pi)
    round_field = picture.field is not None and len(picture.field.rim(picture.shape)) > 0
    score = PictureScore(
        picture.name,
        picture.source,
        picture.kind,
        picture.decision,
        found,
        false,
        on_instrument,
        tracker.confidence,
        dice,
        *field_errors(picture.field, field, picture.shape),
        picture.notch is not None,
        notch_error,
        round_field and picture.notch is None and notch is not None,
        tracker.reason,
    )
    return score, points


def field_errors(
    marked: MarkedField | None, found: FieldOfView | None, shape: tuple[int, int]
) -> tuple[float, float]:
    """Intersection over union with a marked field, and the error of its rim in radii; NaN if not marked."""
    if marked is None:
        return nan, nan
    if found is None:
        return 0.0, nan
    one, two = marked.mask(shape), found.mask(shape, margin=-0.5)
    shared = float((one & two).sum() / max((one | two).sum(), 1))
    rim = marked.rim(shape)
    if not len(rim) or not np.isfinite(found.radius):
        return shared, nan
    away = np.abs(np.hypot(*(rim - found.centre).T) - found.radius)
    return shared, float(np.percentile(away, 95) / found.radius)


def mean(values: Sequence[float]) -> float:
    """Mean of the values that are known; NaN without any."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else nan


def _judged(picture: MarkedPicture, points: Array | None) -> tuple[bool, bool, int]:
    """Whether the gap is found, whether something else is taken for one, and points on instruments."""
    if points is None:
        return False, False, 0
    made = picture.mask(Region.INSTRUMENT) | picture.mask(Region.DRAWN)
    on_instrument = sum(_at(made, point) for point in points)
    middle = points.mean(axis=0)
    reach = 2 * round(BESIDE * min(picture.shape)) + 1
    gap = cv2.dilate(picture.mask(Region.GAP).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    if picture.decision is Decision.UNCLEAR:
        return False, False, on_instrument
    if _at(gap, middle):
        return True, False, on_instrument
    return False, not _at(picture.mask(Region.UNCLEAR), middle), on_instrument


def _at(mask: Mask, pixel: Array) -> bool:
    column, row = np.clip(np.rint(pixel).astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1])
    return bool(mask[row, column])
