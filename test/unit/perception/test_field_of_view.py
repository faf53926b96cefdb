"""The disc of the scope, drawn and real."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from endoscope_images import LAPAROSCOPE, RIGID_ENDOSCOPE, laparoscope_video, rigid_endoscope
from recordings import origins

from knee_gap_core.values.arrays import Image
from knee_gap_perception.image.field_of_view import FieldOfView, FieldOfViewFinder, find_field_of_view


def disc(
    size: tuple[int, int],
    centre: tuple[float, float],
    radius: float,
    level: float = 150.0,
    surround: float = 3.0,
) -> Image:
    """A disc of tissue with a dark bar through it, on a noisy dark surround."""
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]]
    inside = np.hypot(columns - centre[0], rows - centre[1]) < radius
    image = np.where(inside, level, surround)
    image[inside & (np.abs(rows - centre[1] - 0.2 * (columns - centre[0])) < 0.2 * radius)] = 0.08 * level
    noise = np.random.default_rng(3).normal(0, 2, image.shape)
    return np.repeat(np.clip(image + noise, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("size", "centre", "radius"),
    [
        ((1280, 720), (640, 360), 350),
        ((1280, 720), (600, 380), 250),
        ((1920, 1080), (995, 544), 527),
        ((1280, 720), (640, 360), 480),  # cut by the frame above and below
        ((720, 1280), (360, 640), 340),
    ],
)
@pytest.mark.parametrize("level", [40.0, 150.0, 240.0])
def test_disc_is_found(
    size: tuple[int, int], centre: tuple[float, float], radius: float, level: float
) -> None:
    field = find_field_of_view(disc(size, centre, radius, level))
    assert field is not None
    pixel = min(size) / 180  # of the size at which it is looked for
    np.testing.assert_allclose(field.centre, centre, atol=pixel)
    assert field.radius == pytest.approx(radius, abs=pixel)


def test_letterbox_bars_are_not_the_disc() -> None:
    image = disc((1280, 720), (640, 360), 480)
    image[:90] = image[-90:] = 16
    field = find_field_of_view(image)
    assert field is not None
    assert field.radius == pytest.approx(480, abs=6)
    assert field.box[1] == pytest.approx(90, abs=5)
    assert field.box[3] == pytest.approx(629, abs=5)
    assert field.depth_inside([640, 60]) < 0 < field.depth_inside([640, 120])


def test_a_picture_that_fills_the_frame_has_no_disc() -> None:
    rng = np.random.default_rng(1)
    image = np.clip(rng.normal(120, 20, (720, 1280, 3)), 0, 255).astype(np.uint8)
    field = find_field_of_view(image)
    assert field is not None
    assert np.isinf(field.radius)
    assert field.depth_inside([5.0, 360.0]) == pytest.approx(5.0, abs=1.0)


def test_nothing_is_found_in_the_dark() -> None:
    assert find_field_of_view(np.zeros((720, 1280, 3), np.uint8)) is None
    noise = np.random.default_rng(2).integers(0, 8, (720, 1280, 3)).astype(np.uint8)
    assert find_field_of_view(noise) is None


def test_mask_agrees_with_depth() -> None:
    field = find_field_of_view(disc((1280, 720), (640, 360), 350))
    assert field is not None
    full, quarter = field.mask((720, 1280)), field.mask((180, 320), 0.25)
    assert full.sum() == pytest.approx(np.pi * field.radius**2, rel=0.002)
    assert 16 * quarter.sum() == pytest.approx(full.sum(), rel=0.01)


@pytest.mark.parametrize("margin", [0.0, 40.0, 400.0, -5.0])
@pytest.mark.parametrize("radius", [350.0, 500.0, np.inf])
def test_mask_is_what_lies_deep_enough(radius: float, margin: float) -> None:
    """Of a disc, of one that the box cuts, and of the box alone."""
    field = FieldOfView((637.5, 351.0), radius, (12.0, 30.0, 1270.0, 690.0))
    rows, columns = np.mgrid[:180, :320]
    depth = field.depth_inside((np.stack([columns, rows], axis=-1) + 0.5) / 0.25 - 0.5)
    np.testing.assert_array_equal(field.mask((180, 320), 0.25, margin), depth > margin)


def test_stream_keeps_the_disc_through_dark_images_and_finds_a_new_one_for_a_new_size() -> None:
    finder = FieldOfViewFinder()
    assert finder.find(np.zeros((720, 1280, 3), np.uint8)) is None
    found = finder.find(disc((1280, 720), (640, 360), 350))
    assert found is not None
    assert finder.find(np.zeros((720, 1280, 3), np.uint8)) == found
    smaller = finder.find(disc((640, 480), (320, 240), 200))
    assert smaller is not None
    assert smaller.radius == pytest.approx(200, abs=3)


@pytest.mark.parametrize(
    ("centre", "radius"), [((640, 360), 350), ((640, 360), 180), ((340, 530), 180)], ids=str
)
def test_a_disc_that_grows_shrinks_or_moves_is_found_anew(centre: tuple[int, int], radius: int) -> None:
    finder = FieldOfViewFinder()
    finder.find(disc((1280, 720), (640, 360), 230 if radius == 350 else 340))
    for _ in range(finder.CHECK_EVERY * (finder.MISFITS + 1)):
        field = finder.find(disc((1280, 720), centre, radius))
    assert field is not None
    assert field.radius == pytest.approx(radius, abs=4)
    np.testing.assert_allclose(field.centre, centre, atol=3)


@pytest.mark.parametrize("origin", origins(RIGID_ENDOSCOPE))
def test_real_rigid_endoscope(origin: str, tmp_path: Path) -> None:
    frames, fields = rigid_endoscope(origin, tmp_path), []
    for file in frames.files:
        field = find_field_of_view(cv2.imread(str(file)))
        assert field is not None
        fields.append([*field.centre, field.radius])
    # The scope's own disc does not move in the picture.
    expected = np.tile([*frames.centre, frames.radius], (len(fields), 1))
    np.testing.assert_allclose(fields, expected, atol=3.0)


@pytest.mark.parametrize("origin", origins(LAPAROSCOPE))
def test_real_laparoscope(origin: str, tmp_path: Path) -> None:
    path, radius = laparoscope_video(origin, tmp_path)
    video = cv2.VideoCapture(str(path))
    for _ in range(5):
        read, image = video.read()
        assert read
    field = find_field_of_view(image)
    assert field is not None
    assert field.radius == pytest.approx(radius, abs=5)
    dark = find_field_of_view((image * 0.25).astype(np.uint8))
    assert dark is not None
    assert dark.radius == pytest.approx(radius, abs=12)
