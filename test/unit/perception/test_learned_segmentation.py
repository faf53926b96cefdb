"""The project's own network: what it sees, what is made of what it says, and weights that are not its own."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from knee_gap_core.values.arrays import Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.gap_detection.gap_detector import GapSearch
from knee_gap_perception.gap_detection.learned_gap import learned_gap, learned_sections
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.point_tracking.points_beside_opening import points_beside_opening
from knee_gap_perception.segmentation.learned import WEIGHTS, Classes, Learned
from knee_gap_perception.segmentation.network_input import (
    CHANNELS,
    Square,
    cut_out,
    network_input,
    square_around,
)

ROWS, COLUMNS = np.mgrid[0:180, 0:320]
ROUND = np.hypot(COLUMNS - 159.5, ROWS - 89.5) < 86.0
FIELD = FieldOfView((639.5, 359.5), 344.0, (0.0, 0.0, 1279.0, 719.0))
SCALE = 0.25
NOTHING = np.zeros((180, 320), np.float32)
NO = np.zeros((180, 320), bool)
NONE = (NO, NO)
# A slit near the rim, wider than high.
SLIT = (np.abs(ROWS - 40) < 8) & (np.abs(COLUMNS - 160) < 40)
REGION = (np.array([639.5, 359.5]), 330.0)


def _tissue(seed: int = 3) -> Image:
    rng = np.random.default_rng(seed)
    detail = cv2.GaussianBlur(rng.standard_normal((720, 1280)), (0, 0), 3.0)
    grey = 120.0 + 12.0 * detail / detail.std()
    return np.clip(grey[..., None] * [0.9, 0.95, 1.0], 0, 255).astype(np.uint8)


def test_the_square_holds_the_field_and_may_reach_beyond_the_image() -> None:
    assert square_around(ROUND) == Square(74, 4, 172)
    whole = np.ones((90, 160), bool)
    square = square_around(whole)
    assert square == Square(0, -35, 160)
    part = cut_out(np.full((90, 160, 3), 7, np.uint8), square)
    assert part.shape == (160, 160, 3)
    assert part[:35].max() == part[125:].max() == 0
    assert part[35:125].min() == 7


def test_a_colour_cast_hardly_changes_what_the_network_sees() -> None:
    image = _tissue()[:160, :160]
    field = np.hypot(*(np.mgrid[0:160, 0:160] - 79.5)) < 78.0
    seen = network_input(image, field)
    assert seen.shape == (CHANNELS, 160, 160)
    assert (seen[:, ~field] == 0.0).all()
    cast = np.clip(image * np.array([0.8, 1.1, 1.0]), 0, 255).astype(np.uint8)
    np.testing.assert_allclose(network_input(cast, field)[:3], seen[:3], atol=0.3)
    assert np.abs(image[field].mean(axis=0) - cast[field].mean(axis=0)).max() > 20
    assert not network_input(image, np.zeros_like(field)).any()


def test_the_weights_of_the_package_are_small_and_give_shares_inside_the_field() -> None:
    assert WEIGHTS.stat().st_size <= 2_000_000
    network = Learned()
    small = cv2.resize(_tissue(), (320, 180), interpolation=cv2.INTER_AREA)
    classes = network.classes(small, ROUND)
    for share in classes:
        assert share.shape == ROUND.shape
        assert (share[~ROUND] == 0.0).all()
        assert 0.0 <= share.min() <= share.max() <= 1.0
    again = network.classes(small, ROUND)
    assert all((one == two).all() for one, two in zip(classes, again, strict=True))
    assert not any(share.any() for share in network.classes(small, np.zeros_like(ROUND)))


def test_weights_of_another_shape_are_refused_in_one_line(tmp_path: Path) -> None:
    data = WEIGHTS.read_bytes()
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(data[: len(data) // 2])
    for path, message in (
        (tmp_path / "none.onnx", "is not a file"),
        (cut, "cannot read|not one of the segmentation 'learned'"),
    ):
        with pytest.raises(PerceptionError, match=message) as refusal:
            GapSearch(EdgeParameters(segmentation="learned", network_path=str(path)))
        assert "\n" not in str(refusal.value).strip()


def test_specks_are_no_opening_and_an_instrument_is_not_part_of_one() -> None:
    gap = np.where(SLIT, np.float32(0.9), np.float32(0.02))
    gap[100:103, 100:103] = 0.9
    made = NOTHING.copy()
    made[:, 178:184] = 0.8
    metal = NO.copy()
    metal[:, 140:143] = True
    seen = learned_gap(Classes(gap, made, NOTHING), ROUND, (metal, NO))
    assert not seen.opening[95:110].any()
    assert seen.opening[40, 145:170].all()
    assert not seen.opening[:, 140:143].any()
    assert seen.instruments[40, 140:143].all()
    assert not seen.opening[:, 176:186].any()
    assert seen.instruments[40, 176:186].all()


def test_the_confidence_of_a_section_follows_the_shares_in_it() -> None:
    value = np.full((180, 320), 120, np.uint8)
    found = []
    for share in (0.6, 0.9):
        gap = np.where(SLIT, np.float32(share), np.float32(0.02))
        seen = learned_gap(Classes(gap, NOTHING, NOTHING), ROUND, NONE)
        section, confidence = next(learned_sections(seen, value, FIELD, SCALE, REGION))
        assert abs(section.centre[1] / 4 - 40) < 3
        assert abs(section.across[1]) > 0.9
        found.append(confidence)
    assert 0.0 < found[0] < found[1] < 1.0
    nothing = learned_gap(Classes(NOTHING, NOTHING, NOTHING), ROUND, NONE)
    assert not list(learned_sections(nothing, value, FIELD, SCALE, REGION))


def test_a_dark_part_beside_one_as_dark_is_hardly_an_opening() -> None:
    gap = np.where(SLIT, np.float32(0.9), np.float32(0.02))
    seen = learned_gap(Classes(gap, NOTHING, NOTHING), ROUND, NONE)
    below = ROWS > 40
    found = []
    for upper, lower in ((120, 120), (120, 42)):
        value = np.where(SLIT, 40, np.where(below, lower, upper)).astype(np.uint8)
        found.append(next(learned_sections(seen, value, FIELD, SCALE, REGION))[1])
    assert found[0] > 0.9
    assert found[1] < 0.1


def test_more_sections_lie_apart_along_the_opening() -> None:
    gap = np.where(SLIT, np.float32(0.9), np.float32(0.02))
    seen = learned_gap(Classes(gap, NOTHING, NOTHING), ROUND, NONE)
    value = np.full((180, 320), 120, np.uint8)
    centres = [section.centre / 4 for section, _ in learned_sections(seen, value, FIELD, SCALE, REGION)]
    assert 2 <= len(centres) <= 4
    apart = [np.hypot(*(a - b)) for i, a in enumerate(centres) for b in centres[:i]]
    assert min(apart) > 10


def test_points_are_chosen_beside_an_opening_whose_wall_is_as_bright_as_the_tissue() -> None:
    gap = np.where(SLIT, np.float32(0.9), np.float32(0.02))
    seen = learned_gap(Classes(gap, NOTHING, NOTHING), ROUND, NONE)
    value = np.full((180, 320), 120, np.uint8)
    section, _ = next(learned_sections(seen, value, FIELD, SCALE, REGION))
    grey = np.ascontiguousarray(_tissue()[..., 1])
    nothing = np.zeros((180, 320), bool)
    points = points_beside_opening(grey, section, FIELD, 16.0, (seen.opening, nothing, nothing), SCALE)
    assert points is not None
    upper, lower = sorted(point.pixel[1] for point in points)
    assert 125 - 24 < upper < 130 - 8
    assert 190 + 8 < lower < 195 + 24
    # An instrument that covers one side leaves no place there.
    covered = nothing.copy()
    covered[20:32] = True
    masks = (seen.opening, covered, nothing)
    assert points_beside_opening(grey, section, FIELD, 16.0, masks, SCALE) is None
