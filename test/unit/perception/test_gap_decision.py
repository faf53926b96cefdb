"""Whether a dark part is a gap: an opening, a crease between shaded flanks, one noisy image."""

from typing import Any

import cv2
import numpy as np
import pytest

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.gap_detection.border_sharpness import border_sharpness
from knee_gap_perception.gap_detection.confidence_filter import SPAN, ConfidenceFilter
from knee_gap_perception.image.field_of_view import FieldOfView, FieldOfViewFinder

WIDTH, HEIGHT, RADIUS = 1280, 720, 355
CAMERA = FisheyeCamera(WIDTH, HEIGHT, 458.4, 458.4, WIDTH / 2, HEIGHT / 2)
HALF_BAND = 60.0  # [px]
FRAME_NS = 16_666_667


def banded(upper: float, lower: float, *, gap: float = 9.0) -> Image:
    """Textured tissue and a dark band across; its flanks are lit in full `upper` and `lower` [px] away."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    across = rows - HEIGHT / 2
    fall = np.where(across < 0, upper, lower)
    lit = np.clip((np.abs(across) - HALF_BAND) / fall, 0.0, 1.0)
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 5.0)
    grey = gap + (1.0 + 0.1 * texture / texture.std()) * (170.0 - gap) * lit
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0) + 2.0 * rng.standard_normal(grey.shape)
    grey[np.hypot(columns - WIDTH / 2, across) > RADIUS] = 0.0
    return np.stack([np.clip(share * grey, 0, 255) for share in (0.72, 0.82, 1.0)], axis=2).astype(np.uint8)


def field_of(image: Image) -> FieldOfView:
    field = FieldOfViewFinder().find(image)
    assert field is not None
    return field


def decided(image: Image) -> tuple[EdgeStatus, float]:
    detector = GapEdgeTracker()
    return detector.process(0, image, CAMERA).status, detector.confidence


def test_an_opening_is_a_gap() -> None:
    status, confidence = decided(banded(1.0, 1.0))
    assert status is EdgeStatus.VALID
    assert confidence > 0.9


def test_shade_at_the_rim_does_not_make_an_opening_uneven() -> None:
    alone = decided(banded(1.0, 1.0))[1]
    image = banded(1.0, 1.0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    away = np.hypot(columns - WIDTH / 2, rows - HEIGHT / 2)
    shade = (away < RADIUS - 1) & (away > 0.8 * RADIUS) & (np.abs(rows - HEIGHT / 2) > 2.5 * HALF_BAND)
    # As dark as the opening, with specks.
    image[shade] = np.where(np.random.default_rng(1).random(shade.sum()) < 0.2, 60, 6)[:, None]
    assert abs(decided(image)[1] - alone) < 0.02


def test_points_are_followed_in_a_channel_that_is_not_clipped() -> None:
    image = banded(1.0, 1.0)
    image[..., 1] = np.where(image[..., 1] > 60, 248, image[..., 1])
    detector = GapEdgeTracker()
    for index in range(3):
        edges = detector.process(index * FRAME_NS, cv2.add(image, np.full_like(image, index % 2)), CAMERA)
        assert edges.status is EdgeStatus.VALID, detector.reason
    image[..., 0] = image[..., 2] = image[..., 1]
    detector = GapEdgeTracker()
    assert detector.process(0, image, CAMERA).status is EdgeStatus.LOW_CONTRAST
    assert "textured" in detector.reason


def lit_wall(behind: tuple[float, float, float]) -> Image:
    """A band of another colour (3,) between textured tissue."""
    image = banded(1.0, 1.0).astype(np.float64)
    across = np.abs(np.mgrid[:HEIGHT, :WIDTH][0] - HEIGHT / 2)
    inside = (across < HALF_BAND - 2) & (image.max(axis=2) > 0)
    image[inside] = behind
    noise = 2.0 * np.random.default_rng(4).standard_normal(image.shape[:2])[..., None]
    return np.clip(image + noise * inside[..., None], 0, 255).astype(np.uint8)


def test_a_red_wall_is_a_gap_only_where_it_is_pointed_at() -> None:
    image = lit_wall((30.0, 34.0, 92.0))
    detector = GapEdgeTracker()
    assert detector.process(0, image, CAMERA).status is EdgeStatus.NO_GAP
    assert detector.choose_near([WIDTH / 2, HEIGHT / 2], CAMERA) == ""
    assert detector.process(FRAME_NS, cv2.add(image, np.ones_like(image)), CAMERA).status is EdgeStatus.VALID


def test_a_crease_is_no_gap_where_it_is_pointed_at() -> None:
    detector = GapEdgeTracker()
    detector.process(0, banded(280.0, 280.0, gap=4.0), CAMERA)
    assert "shaded tissue" in detector.choose_near([WIDTH / 2, HEIGHT / 2], CAMERA)


def test_an_opening_under_rounded_bone_is_a_gap() -> None:
    # One side turns away from the lamp, the other is a rim.
    assert decided(banded(60.0, 1.0))[0] is EdgeStatus.VALID


def test_a_black_crease_between_shaded_flanks_is_none() -> None:
    status, confidence = decided(banded(280.0, 280.0, gap=4.0))
    assert status is EdgeStatus.NO_GAP
    assert confidence < 0.5


@pytest.mark.parametrize("side", [0, 1])
def test_sharpness_is_told_for_either_side(side: int) -> None:
    soft, crisp = 20.0, 0.5  # [px]
    rows = np.arange(180)[:, None] - 89.5
    level = np.where(rows < 0, (-rows - 15) / (crisp, soft)[side], (rows - 15) / (soft, crisp)[side])
    value = np.repeat((10 + 150 * np.clip(level, 0.0, 1.0)).astype(np.uint8), 320, axis=1)
    part = np.repeat(np.abs(rows) < 16, 320, axis=1)
    field, nothing = field_of(banded(1.0, 1.0)), np.zeros(part.shape, bool)
    centre, across = np.array([160.0, 90.0]), np.array([0.0, 1.0])
    sharpness = border_sharpness(part, centre, across, value, nothing, field, 0.25)
    assert sharpness[1 - side] < 0.4
    assert sharpness[side] > 0.7
    # What an instrument hides has no border.
    instrument = np.repeat((rows < 0, rows > 0)[side], 320, axis=1)
    hidden = border_sharpness(part, centre, across, value, instrument, field, 0.25)
    assert hidden[side] == 0.0
    assert hidden[1 - side] == sharpness[1 - side]


def test_one_image_decides_by_itself() -> None:
    for confidence in (0.0, 0.3, 0.51, 1.0):
        assert ConfidenceFilter().add(0, confidence) == confidence


def test_images_of_the_last_moment_are_heard_alike() -> None:
    evidence = ConfidenceFilter()
    for stamp in (0, FRAME_NS):
        evidence.add(stamp, 0.2)
    # Log odds -1.386 twice and +1.386 once.
    assert evidence.add(2 * FRAME_NS, 0.8) == pytest.approx(1 / (1 + 4 ** (1 / 3)), abs=1e-12)
    assert evidence.add(2 * FRAME_NS + round(1e9 * SPAN), 0.8) == 0.8


def test_as_many_sure_images_as_were_against_it_turn_the_evidence() -> None:
    evidence = ConfidenceFilter()
    for index in range(3):
        evidence.add(index * FRAME_NS, 0.0)
    heard = [evidence.add((3 + index) * FRAME_NS, 1.0) for index in range(3)]
    assert heard[0] < heard[1] < 0.5 <= heard[2]


def test_evidence_of_another_recording_is_not_heard() -> None:
    evidence = ConfidenceFilter()
    evidence.add(1_000_000_000, 0.0)
    assert evidence.add(990_000_000, 0.9) == 0.9


def test_after_images_without_a_gap_a_track_begins_late_but_soon(joint: Any) -> None:
    crease, gap = banded(280.0, 280.0, gap=4.0), [joint.picture(np.eye(4), seed) for seed in range(6)]
    detector = GapEdgeTracker()
    stamps = iter(range(0, 60 * FRAME_NS, FRAME_NS))
    for _ in range(2):
        assert detector.process(next(stamps), crease, joint.camera).status is EdgeStatus.NO_GAP
    first = detector.process(next(stamps), gap[0], joint.camera)
    assert first.status is EdgeStatus.NO_GAP
    assert "just before" in detector.reason
    assert detector.confidence > 0.9
    statuses = [detector.process(next(stamps), image, joint.camera).status for image in gap[1:]]
    assert statuses[2:] == [EdgeStatus.VALID] * 3


def test_a_click_asks_no_image_before(joint: Any) -> None:
    crease, gap = banded(280.0, 280.0, gap=4.0), joint.picture(np.eye(4), 0)
    detector = GapEdgeTracker()
    for index in range(2):
        detector.process(index * FRAME_NS, crease, joint.camera)
    detector.choose_at([WIDTH / 2, HEIGHT / 2])
    assert detector.process(2 * FRAME_NS, gap, joint.camera).status is EdgeStatus.VALID
