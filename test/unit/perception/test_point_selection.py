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
