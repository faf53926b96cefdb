"""What is not tissue, and what is not a gap, under any white balance: instruments, glare, organs."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest
from recordings import BESIDE

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.image.field_of_view import FieldOfView, brightness
from knee_gap_perception.image.instruments_and_glare import foreign_bodies, least_warmth
from knee_gap_perception.image.shafts import find_shafts
from knee_gap_perception.point_tracking.point_selection import AWAY

WIDTH, HEIGHT, RADIUS = 1280, 720, 355
CENTRE = np.array([WIDTH / 2, HEIGHT / 2])
CAMERA = FisheyeCamera(WIDTH, HEIGHT, 458.4, 458.4, WIDTH / 2, HEIGHT / 2)
FIELD = FieldOfView((WIDTH / 2, HEIGHT / 2), RADIUS, (0.0, 0.0, WIDTH - 1.0, HEIGHT - 1.0))
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
INSIDE = np.hypot(COLUMNS - CENTRE[0], ROWS - CENTRE[1]) < RADIUS
CARTILAGE = np.array([138.0, 155.0, 172.0])
GAP = np.array([14.0, 17.0, 30.0])
# Gains of blue, green and red.
CASTS = [
    (0.8, 1.0, 1.0),
    (1.08, 1.0, 1.0),
    (1.2, 1.0, 1.0),
    (1.35, 1.0, 1.0),
    (1.0, 1.15, 1.0),
    (1.0, 1.0, 0.8),
]
SCALE = 0.25


class Shaft(NamedTuple):
    """The shaft of an instrument from a pixel to another one, half as wide as `half` [px]."""

    start: tuple[float, float]
    end: tuple[float, float]
    half: float = 26.0

    def across(self) -> Array:
        """Distance of each pixel (h, w) from the axis, relative to half the width, infinite off the ends."""
        axis = np.array(self.end) - self.start
        length = np.linalg.norm(axis)
        axis /= length
        along = (COLUMNS - self.start[0]) * axis[0] + (ROWS - self.start[1]) * axis[1]
        side = (ROWS - self.start[1]) * axis[0] - (COLUMNS - self.start[0]) * axis[1]
        return np.where((along > 0) & (along < length), side / self.half, np.inf)

    def mask(self) -> Mask:
        """Pixels (h, w) that show it."""
        return np.asarray((np.abs(self.across()) < 1.0) & INSIDE)


OVER_TISSUE = Shaft((300.0, 560.0), (700.0, 180.0))
BESIDE_THE_GAP = Shaft((1010.0, 560.0), (620.0, 395.0))
COLOURS = {
    "black": np.array([24.0, 24.0, 24.0]),
    "grey": np.array([120.0, 120.0, 120.0]),
    "steel": np.array([190.0, 186.0, 180.0]),
    # It mirrors the tissue.
    "warm": 0.72 * CARTILAGE,
}


def tissue(colour: Array = CARTILAGE) -> Array:
    """Mottled tissue (h, w, 3)."""
    mottled = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(HEIGHT, WIDTH)), (0, 0), 5.0)
    return np.asarray((1.0 + 0.08 * mottled / mottled.std())[..., None] * colour)


def opening(scene: Array, behind: Array = GAP) -> Array:
    """The scene (h, w, 3) with a curved band of another colour (3,) across it."""
    middle = HEIGHT / 2 + 45.0 * np.cos((COLUMNS - CENTRE[0]) / 220.0)
    return np.where((np.abs(ROWS - middle) < 48.0)[..., None], behind, scene)


def with_shaft(scene: Array, kind: str, shaft: Shaft) -> Array:
    """The scene (h, w, 3) behind a shaft of a kind in COLOURS, darker at its flanks as a cylinder is."""
    across = shaft.across()
    shade = 0.45 + 0.55 * np.sqrt(np.clip(1.0 - across**2, 0.0, 1.0))
    return np.where((np.abs(across) < 1.0)[..., None], shade[..., None] * COLOURS[kind], scene)


def picture(scene: Array, cast: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Image:
    """What the camera makes of a scene (h, w, 3): blur, noise, white balance, and the field of view."""
    noise = np.random.default_rng(4).normal(size=(HEIGHT, WIDTH, 1))
    seen = (cv2.GaussianBlur(scene, (0, 0), 1.2) + 2.0 * noise) * cast * INSIDE[..., None]
    return np.asarray(np.clip(seen, 0, 255), np.uint8)


def reduced(image: Image) -> Image:
    return np.asarray(cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA), np.uint8)


def reduced_mask(mask: Mask, margin: int = 0) -> Mask:
    """A mask at working size, made narrower by a margin [px]."""
    small = reduced(mask.astype(np.uint8) * 255) > 127
    return cv2.erode(small.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0


def shafts_in(image: Image) -> Mask:
    small = reduced(image)
    return find_shafts(small, brightness(small), FIELD, SCALE, least_warmth(image))


def decided(image: Image) -> tuple[EdgeStatus, Array]:
    """Status, and the points (2, 2) [px]."""
    edges = GapEdgeTracker().process(0, image, CAMERA)
    return edges.status, edges.pixels


@pytest.mark.parametrize("cast", CASTS)
def test_a_gap_is_found_under_any_white_balance(cast: tuple[float, float, float]) -> None:
    image = picture(opening(tissue()), cast)
    assert decided(image)[0] is EdgeStatus.VALID
    inside = reduced_mask(INSIDE, 3)
    assert foreign_bodies(reduced(image), least_warmth(image))[inside].mean() < 0.01


@pytest.mark.parametrize("cast", CASTS)
def test_steel_of_any_shape_is_cooler_than_tissue(cast: tuple[float, float, float]) -> None:
    hook = np.hypot(COLUMNS - 700.0, ROWS - 200.0) < 60.0
    image = picture(np.where(hook[..., None], COLOURS["steel"], tissue()), cast)
    found = foreign_bodies(reduced(image), least_warmth(image))
    assert found[reduced_mask(hook, 1)].mean() > 0.95
    assert found[reduced_mask(INSIDE & ~hook, 4)].mean() < 0.01


def test_grey_pictures_show_no_metal() -> None:
    image = picture(opening(tissue()))
    grey = np.repeat(image[..., 1:2], 3, axis=2)
    assert not foreign_bodies(reduced(grey), least_warmth(grey)).any()
    assert decided(np.ascontiguousarray(grey))[0] is EdgeStatus.VALID


def test_glare_is_small_and_overexposed_tissue_is_not() -> None:
    glare = np.hypot(COLUMNS - 560.0, ROWS - 180.0) < 20.0
    overexposed = np.hypot(COLUMNS - 700.0, ROWS - 560.0) < 120.0
    image = picture(np.where((glare | overexposed)[..., None], 255.0, tissue()))
    found = foreign_bodies(reduced(image), least_warmth(image))
    assert found[reduced_mask(glare, 1)].all()
    assert not found[reduced_mask(overexposed, 3)].any()


@pytest.mark.parametrize("kind", COLOURS)
def test_shafts_are_found_by_their_shape(kind: str) -> None:
    found = shafts_in(picture(with_shaft(tissue(), kind, OVER_TISSUE)))
    # Of a shiny one perhaps only a part, but points stay farther away than its other edge lies.
    near = cv2.dilate(found.astype(np.uint8), np.ones((2 * AWAY + 1, 2 * AWAY + 1), np.uint8)) > 0
    assert near[reduced_mask(OVER_TISSUE.mask(), 1)].mean() > 0.98
    assert found[reduced_mask(OVER_TISSUE.mask(), 1)].mean() > 0.45
    assert found[reduced_mask(INSIDE & ~OVER_TISSUE.mask(), 4)].mean() < 0.02


@pytest.mark.parametrize("kind", COLOURS)
def test_an_instrument_before_tissue_is_no_gap(kind: str) -> None:
    right_through = Shaft((330.0, 520.0), (960.0, 230.0), 34.0)
    assert decided(picture(with_shaft(tissue(), kind, right_through)))[0] is not EdgeStatus.VALID


@pytest.mark.parametrize("kind", COLOURS)
def test_no_point_lies_on_an_instrument_beside_the_gap(kind: str) -> None:
    status, pixels = decided(picture(with_shaft(opening(tissue()), kind, BESIDE_THE_GAP)))
    assert status is EdgeStatus.VALID
    column, row = np.rint(pixels).astype(int).T
    assert not BESIDE_THE_GAP.mask()[row, column].any()


def test_a_gap_with_straight_sides_is_no_shaft() -> None:
    band = np.abs(ROWS - HEIGHT / 2) < 50.0
    image = picture(np.where(band[..., None], GAP, tissue()))
    assert not shafts_in(image).any()
    assert decided(image)[0] is EdgeStatus.VALID


def test_a_dark_organ_is_no_gap_and_a_lit_far_wall_is() -> None:
    wall, organ = 0.42 * CARTILAGE, np.array([42.0, 36.0, 84.0])
    assert decided(picture(opening(tissue(), wall)))[0] is EdgeStatus.VALID
    status, _ = decided(picture(opening(tissue(), organ)))
    assert status is EdgeStatus.NO_GAP


FAILURES = BESIDE / "failures" / "picture"
needs_failures = pytest.mark.skipif(
    not FAILURES.is_dir(), reason="recordings of others: not at ../shared/data"
)


def read(name: str) -> Image:
    return np.asarray(cv2.imread(str(FAILURES / f"{name}.jpg")), np.uint8)


def decided_small(image: Image) -> tuple[EdgeStatus, Array]:
    """As `decided`, for a picture of 640x360 px."""
    camera = FisheyeCamera(640, 360, 229.2, 229.2, 319.5, 179.5)
    edges = GapEdgeTracker().process(0, image, camera)
    return edges.status, edges.pixels


@needs_failures
@pytest.mark.parametrize("name", ["dark_instrument", "lit_dark_organ", "grey_metal"])
def test_pictures_that_were_taken_for_gaps(name: str) -> None:
    assert decided_small(read(name))[0] is not EdgeStatus.VALID


@needs_failures
@pytest.mark.parametrize("name", ["neutral_cartilage_sim", "neutral_cartilage_sim_as_rendered"])
def test_neutral_cartilage_is_tissue(name: str) -> None:
    assert decided_small(read(name))[0] is EdgeStatus.VALID


@needs_failures
def test_no_point_lies_on_the_warm_bar() -> None:
    status, pixels = decided_small(read("warm_metal"))
    assert status is not EdgeStatus.VALID or not ((pixels[:, 1] > 198) & (pixels[:, 1] < 252)).any()


def confidence_of(folder: str, name: str) -> float:
    """Confidence that a real picture shows a gap; 0 where no dark part was found."""
    image = np.asarray(cv2.imread(str(BESIDE / "images" / folder / name)), np.uint8)
    height, width = image.shape[:2]
    tracker = GapEdgeTracker()
    tracker.process(0, image, FisheyeCamera(width, height, 0.6 * height, 0.6 * height, width / 2, height / 2))
    return float(np.nan_to_num(tracker.confidence))


needs_images = pytest.mark.skipif(
    not (BESIDE / "images").is_dir(), reason="recordings of others: not at ../shared/data"
)


@needs_images
@pytest.mark.parametrize("frame", [4588, 4592, 4598])
def test_the_cleft_of_a_nose_is_a_gap(frame: int) -> None:
    assert confidence_of("sinus_endoscope", f"{frame:08d}.jpg") > 0.5


@needs_images
@pytest.mark.parametrize("frame", [1, 3, 6, 9, 12, 15])
def test_organs_of_an_abdomen_are_no_gap(frame: int) -> None:
    assert confidence_of("laparoscopy_no_gap", f"{frame}.png") < 0.2
