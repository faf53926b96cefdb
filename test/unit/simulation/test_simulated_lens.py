"""The simulated lens against its own definition and against OpenCV's fisheye model."""

import cv2
import numpy as np
import pytest

from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.scope.lens import Lens


@pytest.fixture
def pixels() -> np.ndarray:
    rng = np.random.default_rng(3)
    radius, angle = 359.0 * np.sqrt(rng.random(500)), rng.uniform(0.0, 2.0 * np.pi, 500)
    lens = Lens()
    return np.stack(
        [lens.centre_x_px + radius * np.cos(angle), lens.centre_y_px + radius * np.sin(angle)], axis=-1
    )


def test_pixels_come_back(pixels):
    lens = Lens()
    bearings = lens.bearings(pixels)
    assert np.linalg.norm(bearings, axis=-1) == pytest.approx(1.0, abs=1e-14)
    assert np.abs(lens.pixels(7.0 * bearings) - pixels).max() < 1e-10


def test_opencv_fisheye_agrees(pixels):
    lens = Lens()
    matrix = np.array(
        [[lens.focal_px, 0.0, lens.centre_x_px], [0.0, lens.focal_px, lens.centre_y_px], [0.0, 0.0, 1.0]]
    )
    points = lens.bearings(pixels).reshape(-1, 1, 3)
    projected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.zeros(4))[0]
    assert np.abs(projected.reshape(-1, 2) - pixels).max() < 1e-6


def test_the_centre_looks_straight_ahead():
    lens = Lens()
    assert lens.bearings([lens.centre_x_px, lens.centre_y_px]) == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)


def test_nothing_is_seen_outside_the_field_of_view():
    lens = Lens()
    outside = [lens.centre_x_px + lens.radius_px + 0.01, lens.centre_y_px]
    inside = [lens.centre_x_px + lens.radius_px - 0.01, lens.centre_y_px]
    bearings = lens.bearings([outside, inside])
    assert np.isnan(bearings[0]).all()
    assert np.isfinite(bearings[1]).all()
    assert np.isnan(lens.pixels([[1.0, 0.0, 0.9], [0.0, 0.0, -1.0]])).all()


def test_the_field_stop_is_the_disc_of_the_field_of_view():
    lens = Lens()
    stop = lens.field_stop()
    seen = np.isfinite(lens.bearings(lens.pixel_grid())[..., 0])
    assert not stop[~seen].any()
    assert (stop[seen] == 1.0).mean() > 0.99


def test_impossible_lenses_are_refused():
    with pytest.raises(SimulationError, match="field_of_view"):
        Lens(field_of_view=4.0)
    with pytest.raises(SimulationError, match="16 px"):
        Lens(width_px=4)
