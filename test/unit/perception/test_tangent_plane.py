"""The tangent plane at a point: learnt from registrations, and never surer than one of them allows."""

import numpy as np
import pytest

from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.point_tracking.tangent_plane import TangentPlane, View

CAMERA = FisheyeCamera(1280, 720, 540.0, 540.0, 639.5, 359.5)
PIXEL = np.array([700.0, 400.0])
DEPTH, TRAVEL = 0.010, 0.006
ERROR = np.diag([0.25, 0.25, 1e-4, 1e-4, 1e-4, 1e-4])


def _view(x: float) -> View:
    T = np.eye(4)
    T[0, 3] = x
    return View(T, 2e-5, 4e-5)


def _learnt(images: int, plane: TangentPlane | None = None, start: float = 0.0) -> TangentPlane:
    """A plane across the optical axis, seen from `images` places along the travel without error."""
    bearing = CAMERA.bearings(PIXEL)
    plane = plane or TangentPlane(bearing, _view(0.0))
    truth = TangentPlane(bearing, _view(0.0))
    truth.mean = np.array([0.0, 0.0, 1.0 / DEPTH])
    for x in np.linspace(start, TRAVEL, images + 1)[1:]:
        prediction = plane.predict(CAMERA, _view(0.0), PIXEL, _view(x))
        seen = truth.predict(CAMERA, _view(0.0), PIXEL, _view(x))
        assert prediction is not None
        assert seen is not None
        posterior = np.linalg.inv(np.linalg.inv(prediction.covariance) + np.linalg.inv(ERROR))
        predicted = np.concatenate([prediction.warp.position, prediction.warp.shape.reshape(-1)])
        true = np.concatenate([seen.warp.position, seen.warp.shape.reshape(-1)])
        found = predicted + posterior @ np.linalg.solve(ERROR, true - predicted)
        plane.learn(prediction, found, posterior, _view(x))
    return plane


def _depth_error(plane: TangentPlane) -> float:
    """Standard deviation of the inverse distance along the point's bearing, against it."""
    bearing = CAMERA.bearings(PIXEL)
    return float(np.sqrt(bearing @ plane.covariance @ bearing) / (bearing @ plane.mean))


def test_plane_is_learnt_from_the_parallax():
    plane = _learnt(40)
    bearing = CAMERA.bearings(PIXEL)
    assert bearing @ plane.mean == pytest.approx(bearing[2] / DEPTH, rel=0.02)


def test_more_images_of_the_same_travel_do_not_make_it_surer():
    few, many = _depth_error(_learnt(40)), _depth_error(_learnt(400))
    assert many == pytest.approx(few, rel=0.35)
    # One registration at the end of the travel knows the parallax to half a pixel.
    parallax_px = 540.0 * TRAVEL / DEPTH
    assert many > 0.3 * 0.5 / parallax_px


def test_standing_still_teaches_nothing():
    plane = _learnt(40)
    before = _depth_error(plane)
    for _ in range(100):
        _learnt(1, plane, TRAVEL)
    assert _depth_error(plane) == pytest.approx(before, rel=1e-9)


def test_it_forgets_while_nothing_is_seen_of_it():
    """A registration without information leaves the plane less sure than before, never surer."""
    plane = _learnt(40)
    before = _depth_error(plane)
    for x in np.linspace(TRAVEL, 2 * TRAVEL, 20)[1:]:
        prediction = plane.predict(CAMERA, _view(0.0), PIXEL, _view(x))
        assert prediction is not None
        predicted = np.concatenate([prediction.warp.position, prediction.warp.shape.reshape(-1)])
        plane.learn(prediction, predicted, prediction.covariance, _view(x))
    assert _depth_error(plane) > 1.2 * before
