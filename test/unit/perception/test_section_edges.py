"""The edges of the opening in pictures drawn with edges at known places."""

import cv2
import numpy as np
import pytest

from knee_gap_core.values.edges import EdgeState
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.gap_detection.section_edges import SectionEdgeFinder, largest_circle
from knee_gap_perception.image.field_of_view import FieldOfView

CAMERA = FisheyeCamera(1280, 720, 640.0, 640.0, 639.5, 359.5)
FIELD = FieldOfView((639.5, 359.5), 355.0, (-0.5, -0.5, 1279.5, 719.5))
SCALE = 0.25
NOTHING = np.zeros((180, 320), bool)
CENTRE = np.array([640.0, 360.0])
ACROSS = np.array([0.0, 1.0])


def picture(upper, lower, *, blur=1.5, gap=20, tissue=170, noise=2.0):
    """Grey image that is dark between two lines; rows as functions of the column."""
    columns, rows = np.meshgrid(np.arange(1280.0), np.arange(720.0))
    dark = (rows > upper(columns)) & (rows < lower(columns))
    image = np.where(dark, float(gap), float(tissue))
    image = cv2.GaussianBlur(image, (0, 0), blur)
    image += noise * np.random.default_rng(3).standard_normal(image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def straight(row):
    return lambda columns: np.full_like(columns, row)


def points(upper=275.0, lower=445.0, column=640.0):
    return np.array([[column, upper], [column, lower]])


def find(image, places=None, *, finder=None, foreign=NOTHING, stamp_ns=0, field=FIELD, profile=False):
    places = points() if places is None else places
    finder = finder or SectionEdgeFinder(CENTRE, ACROSS, places)
    return finder.find(stamp_ns, image, foreign, SCALE, field, CAMERA, places, profile=profile)


@pytest.mark.parametrize(("upper", "lower"), [(300.0, 420.0), (303.4, 415.7), (310.0, 430.0)])
def test_straight_edges_are_found_where_they_are(upper, lower):
    edges, _ = find(picture(straight(upper), straight(lower)))
    assert edges.seen
    # Tissue begins before the middle of a blurred border, so that the opening is not taken for too wide.
    assert edges.pixels[0, 1] == pytest.approx(upper, abs=2.0)
    assert edges.pixels[1, 1] == pytest.approx(lower, abs=2.0)
    assert edges.pixels[0, 1] >= upper - 0.7
    assert edges.pixels[1, 1] <= lower + 0.7
    np.testing.assert_allclose(edges.bearings, CAMERA.bearings(edges.pixels))
    assert edges.error >= edges.deviations.max()


def test_a_slanted_opening_is_measured_across_and_not_along_the_section_it_was_begun_with():
    slope = np.tan(np.radians(20.0))
    image = picture(lambda u: 300.0 + slope * (u - 640.0), lambda u: 420.0 + slope * (u - 640.0))
    edges, _ = find(image, points(262.0, 458.0))
    width = np.linalg.norm(edges.pixels[1] - edges.pixels[0])
    assert width == pytest.approx(120.0 * np.cos(np.radians(20.0)), abs=3.0)


def test_tissue_beside_the_line_counts_as_far_as_the_instrument_reaches():
    """A tongue of tissue 40 px beside the section leaves a smaller circle than the section's own line."""
    image = picture(straight(300.0), lambda u: np.where(np.abs(u - 680.0) < 12.0, 380.0, 420.0))
    edges, _ = find(image)
    tongue = np.linalg.norm(edges.pixels[1] - edges.pixels[0])
    far = picture(straight(300.0), lambda u: np.where(np.abs(u - 800.0) < 12.0, 380.0, 420.0))
    edges, _ = find(far)
    assert np.linalg.norm(edges.pixels[1] - edges.pixels[0]) == pytest.approx(120.0, abs=4.0)
    assert tongue < 112.0


def test_a_blurred_edge_has_a_larger_error():
    sharp, _ = find(picture(straight(300.0), straight(420.0)))
    soft, _ = find(picture(straight(300.0), straight(420.0), blur=6.0))
    assert soft.error > 1.5 * sharp.error


def test_an_edge_under_an_instrument_is_unknown():
    foreign = NOTHING.copy()
    foreign[68:82, 150:170] = True
    edges, _ = find(picture(straight(300.0), straight(420.0)), foreign=foreign)
    assert edges.states == (EdgeState.UNKNOWN, EdgeState.SEEN)
    assert np.isnan(edges.bearings[0]).all()
    assert np.isfinite(edges.bearings[1]).all()


def test_an_edge_at_the_border_of_the_picture_is_said_to_be_there():
    field = FieldOfView((639.5, 359.5), 60.0, (-0.5, -0.5, 1279.5, 719.5))
    edges, _ = find(picture(straight(300.0), straight(420.0)), field=field)
    assert EdgeState.AT_BORDER in edges.states
    assert np.isfinite(edges.bearings).all()


def test_an_edge_that_jumps_is_not_believed_before_it_stays():
    finder = SectionEdgeFinder(CENTRE, ACROSS, points())
    before, after = (picture(straight(row), straight(420.0)) for row in (300.0, 330.0))
    assert find(before, finder=finder)[0].seen
    assert not find(after, finder=finder, stamp_ns=16_000_000)[0].seen
    assert find(before, finder=finder, stamp_ns=32_000_000)[0].seen
    assert not find(after, finder=finder, stamp_ns=48_000_000)[0].seen
    assert find(after, finder=finder, stamp_ns=1_100_000_000)[0].seen


def test_one_image_after_a_long_time_does_not_move_an_edge():
    finder = SectionEdgeFinder(CENTRE, ACROSS, points())
    before, after = (picture(straight(row), straight(420.0)) for row in (300.0, 340.0))
    assert find(before, finder=finder)[0].seen
    assert not find(after, finder=finder, stamp_ns=900_000_000)[0].seen
    assert find(after, finder=finder, stamp_ns=917_000_000)[0].seen


def test_without_a_step_in_brightness_there_is_no_edge():
    edges, more = find(picture(straight(300.0), straight(420.0), tissue=26), profile=True)
    assert edges.states == (EdgeState.UNKNOWN, EdgeState.UNKNOWN)
    assert more == ()


def test_a_profile_shows_how_the_opening_widens():
    image = picture(lambda u: 300.0 - 0.15 * (u - 640.0), lambda u: 420.0 + 0.15 * (u - 640.0))
    _, sections = find(image, points(270.0, 450.0), profile=True)
    widths = [float(np.linalg.norm(one.pixels[1] - one.pixels[0])) for one in sections if one.seen]
    assert len(widths) >= 5
    assert widths == sorted(widths) or widths == sorted(widths, reverse=True)


def test_points_that_cannot_be_are_no_edges():
    image = picture(straight(300.0), straight(420.0))
    assert not find(image, np.full((2, 2), np.nan))[0].seen
    assert not find(image, np.array([[640.0, -1e9], [640.0, 1e9]]))[0].seen


def test_the_largest_circle_between_two_lines_touches_both():
    rows = np.arange(-200.0, 201.0, 4.0)
    circle = largest_circle(rows, (np.full(rows.size, 50.0), np.full(rows.size, 70.0)))
    assert circle.radius == pytest.approx(60.0, abs=0.6)
    assert circle.offset == pytest.approx(10.0, abs=0.9)
    assert rows[list(circle.contacts)] == pytest.approx([0.0, 0.0])


def test_the_largest_circle_is_never_larger_than_the_nearest_border_allows():
    rng = np.random.default_rng(4)
    rows = np.arange(-200.0, 201.0, 4.0)
    for _ in range(20):
        borders = tuple(60.0 + 12.0 * rng.standard_normal(rows.size) for _ in range(2))
        circle = largest_circle(rows, borders)
        for sign, border in ((1.0, borders[0]), (-1.0, borders[1])):
            away = np.hypot(border + sign * circle.offset, rows)
            assert away.min() >= circle.radius - 1e-9
