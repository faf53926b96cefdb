"""The disc of the scope, drawn and real."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from endoscope_images import LAPAROSCOPE, RIGID_ENDOSCOPE, laparoscope_video, rigid_endoscope
from recordings import origins

from knee_gap_core.values.arrays import Image
from knee_gap_perception.image.field_of_view import (
    NO_BORDER,
    TOO_DARK,
    FieldOfView,
    FieldOfViewFinder,
    find_field_of_view,
    why_no_field,
)


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


def picture_of(
    centre: tuple[float, float],
    radii: tuple[float, float],
    surround: Image,
    seed: int = 0,
) -> Image:
    """Tissue with a gap from rim to rim and a bright and a dark half, in an ellipse, on a surround."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0 : surround.shape[0], 0 : surround.shape[1]].astype(np.float32)
    x, y = (columns - centre[0]) / radii[0], (rows - centre[1]) / radii[1]
    away = np.hypot(x, y)
    light = (150.0 + 60.0 * x) * (1.0 - 0.3 * away**2)
    light[np.abs(y - 0.3 * x - 0.2) < 0.12] = 25.0
    tissue = light[..., None] * np.array([0.75, 0.82, 1.0], np.float32)
    inside = np.clip((1.0 - away) * radii[0] / 2.0, 0.0, 1.0)[..., None]
    image = inside * tissue + (1.0 - inside) * surround
    return np.asarray(np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255), np.uint8)


def even(size: tuple[int, int], *colour: float) -> Image:
    return np.full((size[1], size[0], 3), colour, np.uint8)


HD, SMALL = (1280, 720), (640, 360)


def reflecting(size: tuple[int, int]) -> Image:
    """A screen that was photographed: grey with a bright reflection, and a white strip beside it."""
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]]
    image = 30.0 + 45.0 * np.exp(-(((columns - 0.9 * size[0]) / 90.0) ** 2 + ((rows - 60.0) / 80.0) ** 2))
    image[:, : size[0] // 30] = 220.0
    return np.repeat(image.astype(np.uint8)[..., None], 3, axis=2)


def labelled(size: tuple[int, int]) -> Image:
    """Text and a symbol beside the disc, and text across its rim."""
    image = even(size, 0, 0, 0)
    for row, text in enumerate(("PATIENT 42", "12:31:07", "KNEE")):
        place = (10, 60 + 200 * row)
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 1.2, (255, 255, 255), 3)
    cv2.rectangle(image, (1130, 600), (1260, 700), (200, 200, 200), -1)
    return image


@pytest.mark.parametrize(
    ("surround", "centre", "radius"),
    [
        (even(SMALL, 42, 42, 42), (320.0, 180.0), 170.0),
        (even(SMALL, 90, 90, 90), (300.0, 190.0), 150.0),
        (even(HD, 120, 40, 30), (640.0, 360.0), 340.0),
        (even(SMALL, 30, 30, 30), (320.0, 180.0), 334.0),  # dark corners alone
        (even(SMALL, 0, 0, 0), (322.0, 178.0), 330.0),
        (even(SMALL, 0, 0, 0), (315.0, 182.0), 345.0),
        (even(HD, 3, 3, 3), (640.0, 360.0), 560.0),  # cut above and below
        (reflecting(SMALL), (330.0, 180.0), 200.0),
        (labelled(HD), (700.0, 360.0), 350.0),
    ],
    ids=("grey", "light grey", "blue", "grey corners", "corners", "smaller corners", "cut", "screen", "text"),
)
@pytest.mark.parametrize("seed", [0, 1])
def test_disc_on_other_surrounds(
    surround: Image, centre: tuple[float, float], radius: float, seed: int
) -> None:
    field = find_field_of_view(picture_of(centre, (radius, radius), surround, seed))
    assert field is not None
    np.testing.assert_allclose(field.centre, centre, atol=0.025 * radius)
    assert field.radius == pytest.approx(radius, rel=0.025)


def test_a_disc_that_ends_in_black_along_a_curve_is_cut_there() -> None:
    """As where the video was undistorted: above from row 60 to 85, below from row 660 to 645."""
    image = picture_of((640.0, 360.0), (350.0, 350.0), even(HD, 2, 2, 2))
    rows, columns = np.mgrid[0:720, 0:1280]
    bend = ((columns - 640.0) / 350.0) ** 2
    image[rows < 85.0 - 25.0 * bend] = image[rows > 645.0 + 15.0 * bend] = 2
    field = find_field_of_view(image)
    assert field is not None
    assert field.radius == pytest.approx(350.0, rel=0.025)
    assert 55.0 < field.box[1] < 90.0
    assert 640.0 < field.box[3] < 665.0
    assert (field.box[0], field.box[2]) == (0.0, 1279.0)


@pytest.mark.parametrize("level", [14, 25])
def test_a_gap_along_the_rim_does_not_cut_the_disc(level: int) -> None:
    image = picture_of((640.0, 360.0), (350.0, 350.0), even(HD, 2, 2, 2))
    rows, columns = np.mgrid[0:720, 0:1280]
    image[(rows < 90) & (np.hypot(columns - 640, rows - 360) < 350)] = level
    field = find_field_of_view(image)
    assert field is not None
    assert field.radius == pytest.approx(350.0, rel=0.025)
    assert field.box == (0.0, 0.0, 1279.0, 719.0)


def test_the_disc_of_a_stretched_picture_is_about_its_middle() -> None:
    field = find_field_of_view(picture_of((640.0, 360.0), (370.0, 342.0), even(HD, 2, 2, 2)))
    assert field is not None
    np.testing.assert_allclose(field.centre, (640.0, 360.0), atol=10.0)
    assert 340.0 < field.radius < 372.0


def test_what_fills_the_frame_has_no_disc_whatever_is_round_in_it() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        image = np.clip(rng.normal(130, 3, (360, 640, 3)), 0, 255).astype(np.uint8)
        centre = (int(rng.uniform(200, 440)), int(rng.uniform(120, 240)))
        cv2.circle(image, centre, int(rng.uniform(60, 110)), (30, 40, 60), -1)
        cv2.circle(image, (320, 180), 150, (220, 220, 230), 9)
        field = find_field_of_view(image)
        assert field is not None
        assert np.isinf(field.radius)


def test_it_is_said_why_no_field_is_found() -> None:
    dark = np.full((360, 640, 3), 3, np.uint8)
    assert find_field_of_view(dark) is None
    assert why_no_field(dark) == TOO_DARK
    # A lit corner, as when tissue lies on half of the lens.
    half = dark.copy()
    cv2.fillPoly(half, [np.array([[150, 0], [400, 0], [0, 300], [0, 150]])], (90, 100, 140))
    assert find_field_of_view(half) is None
    assert why_no_field(half) == NO_BORDER


def test_a_light_surround_does_not_make_the_stream_search_at_every_check() -> None:
    finder, searches = FieldOfViewFinder(), []
    image = picture_of((320.0, 180.0), (150.0, 150.0), even(SMALL, 90, 90, 90))
    for _ in range(40):
        searches.append(finder.find(image))
    # The same object as long as it is not looked for again.
    assert len({id(field) for field in searches}) == 1
