"""Where beside the edges of a gap the points are put."""

import cv2
import numpy as np

from knee_gap_perception.gap_detection.cross_section import Section
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.point_tracking.point_selection import AWAY, SurfacePoint, choose_points

SCALE = 0.25
INSET_PX = 16.0
SECTION = Section(
    centre=np.array([640.0, 360.0]),
    radius=60.0,
    edges=np.array([[640.0, 300.0], [640.0, 420.0]]),
    contrast=np.array([0.8, 0.8]),
    levels=np.array([20.0, 130.0, 130.0]),
    sharpness=np.array([0.9, 0.9]),
)
FIELD = FieldOfView((639.5, 359.5), 355.0, (0.0, 0.0, 1279.0, 719.0))
NOTHING = np.zeros((180, 320), bool)


def _gap() -> np.ndarray:
    """Textured tissue (720, 1280) above and below a dark gap of rows 300 to 420; richest at the section."""
    rng = np.random.default_rng(5)
    detail = cv2.GaussianBlur(rng.standard_normal((720, 1280)), (0, 0), 3.0)
    columns = np.arange(1280)
    richness = 4.0 + 8.0 * np.exp(-(((columns - 640.0) / 15.0) ** 2))
    image = 130.0 + richness * detail / detail.std()
    image[300:420] = 20.0
    return np.clip(image, 0, 255).astype(np.uint8)


def _chosen(foreign: np.ndarray) -> list[SurfacePoint] | None:
    return choose_points(_gap(), SECTION, FIELD, INSET_PX, foreign, SCALE)


def test_each_point_lies_inside_its_edge_where_there_is_most_texture():
    upper, lower = _chosen(NOTHING)
    for point, row in ((upper, 300.0 - INSET_PX), (lower, 420.0 + INSET_PX)):
        assert abs(point.pixel[1] - row) <= 0.25 * INSET_PX + 1.0
        assert abs(point.pixel[0] - 640.0) <= 24.0


def test_no_point_is_put_beside_an_instrument_however_rich_its_texture():
    probe = NOTHING.copy()
    probe[60:75, 150:153] = True
    upper, lower = _chosen(probe)
    column = SCALE * upper.pixel[0]
    assert column - 152 > AWAY
    assert abs(lower.pixel[0] - 640.0) <= 24.0


def test_where_every_place_is_beside_an_instrument_there_is_no_point():
    probe = NOTHING.copy()
    probe[60:75, 140:181] = True
    assert _chosen(probe) is None


def test_a_point_may_be_nearer_to_glare_than_to_an_instrument():
    spot = NOTHING.copy()
    spot[66:72, 157:164] = True
    upper, _ = choose_points(_gap(), SECTION, FIELD, INSET_PX, spot, SCALE, instruments=NOTHING)
    # Within the margin of an instrument, and not on the spot itself.
    assert abs(SCALE * upper.pixel[0] - 160.0) < 4 + AWAY
    column, row = np.rint(SCALE * upper.pixel).astype(int)
    assert not spot[row, column]


def test_a_smaller_picture_has_its_points_at_the_same_places():
    scale = 0.4
    small = cv2.resize(_gap(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    section = Section(
        centre=SECTION.centre * scale,
        radius=SECTION.radius * scale,
        edges=SECTION.edges * scale,
        contrast=SECTION.contrast,
        levels=SECTION.levels,
        sharpness=SECTION.sharpness,
    )
    field = FieldOfView((255.5, 143.5), 142.0, (0.0, 0.0, 511.0, 287.0))
    # In the small picture a large patch would not lie inside the field.
    shifted = FieldOfView((255.5, 143.5 + 45.0), 142.0, (0.0, 0.0, 511.0, 287.0))
    for one in (field, shifted):
        points = choose_points(small, section, one, INSET_PX * scale, NOTHING, SCALE / scale)
        upper, lower = (point.pixel / scale for point in points)
        for pixel, row in ((upper, 300.0 - INSET_PX), (lower, 420.0 + INSET_PX)):
            assert abs(pixel[1] - row) <= 0.25 * INSET_PX + 4.0
            assert abs(pixel[0] - 640.0) <= 120.0


def test_points_near_the_rim_are_taken_where_there_are_no_others():
    # The upper edge lies 50 px inside the field.
    low = FieldOfView((639.5, 604.5), 355.0, (0.0, 0.0, 1279.0, 1279.0))
    image = _gap()
    rows, columns = np.mgrid[:720, :1280]
    image[np.hypot(columns - 639.5, rows - 604.5) > 355.0] = 0
    upper, _ = choose_points(image, SECTION, low, INSET_PX, NOTHING, SCALE)
    assert abs(upper.pixel[1] - (300.0 - INSET_PX)) <= 0.25 * INSET_PX + 1.0
    assert low.depth_inside(upper.pixel) > 18.0
    # Beyond the rim there is no tissue.
    outside = FieldOfView((639.5, 650.5), 355.0, (0.0, 0.0, 1279.0, 1279.0))
    assert choose_points(image, SECTION, outside, INSET_PX, NOTHING, SCALE) is None
