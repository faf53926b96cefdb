"""Camera models: there and back, OpenCV's own functions, and silence outside the model."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from knee_gap_perception.camera.camera import Camera, bearing_jacobian
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.camera.models import EquiangularCamera, FisheyeCamera, PinholeCamera
from knee_gap_perception.errors import PerceptionError

MATRIX = (900.0, 905.0, 645.0, 352.0)
BARREL = (-0.35, 0.12, 0.001, -0.0008, -0.02)
RATIONAL = (0.4, -0.1, 0.0005, 0.0003, 0.01, 0.7, -0.05, 0.02)
PRISM = (*RATIONAL, 0.001, -0.0005, 0.0008, 0.0002)
FISHEYE = (0.02, -0.01, 0.004, -0.001)

CAMERAS: dict[str, Camera] = {
    "equiangular": EquiangularCamera(1280, 720),
    "pinhole": PinholeCamera(1280, 720, *MATRIX),
    "barrel": PinholeCamera(1280, 720, *MATRIX, BARREL),
    "rational": PinholeCamera(1280, 720, *MATRIX, RATIONAL),
    "prism": PinholeCamera(1280, 720, *MATRIX, PRISM),
    "equidistant": FisheyeCamera(1280, 720, 458.4, 458.4, 640.0, 360.0),
    "fisheye": FisheyeCamera(1280, 720, 458.4, 450.1, 640.0, 360.0, FISHEYE),
}


def grid() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 21))
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_pixel_to_bearing_and_back(camera: Camera) -> None:
    pixels = grid()
    bearings = camera.bearings(pixels)
    inside = np.isfinite(bearings).all(axis=-1)
    assert inside.mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(bearings[inside], axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(camera.pixels(bearings[inside]), pixels[inside], atol=1e-6)
    np.testing.assert_allclose(camera.pixels(7.0 * bearings[inside]), pixels[inside], atol=1e-6)


@pytest.mark.parametrize(
    "distortion", [(), BARREL, RATIONAL, PRISM], ids=["none", "barrel", "rational", "prism"]
)
def test_pinhole_projects_as_opencv(distortion: tuple[float, ...]) -> None:
    camera = PinholeCamera(1280, 720, *MATRIX, distortion)
    points = np.random.default_rng(0).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.5], (200, 3))
    fx, fy, cx, cy = MATRIX
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    np.testing.assert_allclose(camera.pixels(points), expected[:, 0], atol=1e-9)


def test_fisheye_projects_as_opencv() -> None:
    camera = FisheyeCamera(1280, 720, 458.4, 450.1, 640.0, 360.0, FISHEYE)
    points = np.random.default_rng(1).uniform([-1, -1, 0.5], [1, 1, 1.5], (200, 3))
    matrix = np.array([[458.4, 0, 640.0], [0, 450.1, 360.0], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros((1, 3)), np.zeros((1, 3)), matrix, np.array(FISHEYE)
    )
    np.testing.assert_allclose(camera.pixels(points), expected[:, 0], atol=1e-9)


def test_equiangular_pixel_spans_the_papers_angle() -> None:
    camera = EquiangularCamera(1280, 720)
    left, right = camera.bearings([[600, 359.5], [601, 359.5]])
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(90 / 1280, rel=1e-6)
    above, below = camera.bearings([[639.5, 300], [639.5, 301]])
    assert np.degrees(np.arccos(above @ below)) == pytest.approx(90 / 720, rel=1e-6)
    assert np.degrees(camera.radians_per_pixel([639.5, 359.5])) == pytest.approx(0.125, rel=1e-4)


def test_axes_are_those_of_the_optical_frame() -> None:
    for camera in CAMERAS.values():
        centre = camera.pixels([0, 0, 1.0])
        right, down = camera.bearings(centre + np.array([[50, 0], [0, 50]]))
        assert right[0] > 0.01
        assert down[1] > 0.01


def test_nothing_is_said_outside_the_model() -> None:
    pinhole = PinholeCamera(1280, 720, *MATRIX)
    assert np.isnan(pinhole.pixels([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [np.nan, 0, 1]])).all()
    barrel = PinholeCamera(1280, 720, *MATRIX, (-0.4, 0.0, 0, 0, 0))
    fold = 1 / np.sqrt(1.2)  # where r (1 - 0.4 r^2) stops growing
    assert np.isfinite(barrel.pixels([0.99 * fold, 0, 1.0])).all()
    assert np.isnan(barrel.pixels([1.01 * fold, 0, 1.0])).all()
    assert np.isnan(barrel.bearings([645.0 + 900 * 0.7 * fold, 352.0])).all()
    fisheye = CAMERAS["equidistant"]
    assert np.isfinite(fisheye.pixels([1.0, 0, -0.5])).all()
    assert np.isnan(fisheye.pixels([0, 0, -1.0])).all()
    assert np.isnan(fisheye.pixels([0, 0, 0.0])).all()
    assert np.isnan(fisheye.bearings([640 + 458.4 * 3.2, 360])).all()
    assert np.isnan(fisheye.radians_per_pixel([640 + 458.4 * 3.2, 360]))


def test_jacobian_carries_a_pixel_step_into_the_tangent_plane() -> None:
    camera = CAMERAS["fisheye"]
    pixel = np.array([900.0, 200.0])
    jacobian = bearing_jacobian(camera, pixel)
    np.testing.assert_allclose(camera.bearings(pixel) @ jacobian, 0.0, atol=1e-7)
    step = np.array([0.3, -0.2])
    moved = camera.bearings(pixel + step) - camera.bearings(pixel)
    np.testing.assert_allclose(moved, jacobian @ step, atol=2e-6)


def info(**changes: object) -> SimpleNamespace:
    fields: dict[str, object] = {
        "width": 1280,
        "height": 720,
        "distortion_model": "equidistant",
        "d": np.zeros(4),
        "k": np.array([458.4, 0, 640, 0, 458.4, 360, 0, 0, 1]),
    }
    return SimpleNamespace(**{**fields, **changes})


def test_camera_info_names_the_model() -> None:
    assert camera_from_info(info()) == FisheyeCamera(1280, 720, 458.4, 458.4, 640, 360)
    pinhole = camera_from_info(info(distortion_model="plumb_bob", d=list(BARREL)))
    assert pinhole == PinholeCamera(1280, 720, 458.4, 458.4, 640, 360, BARREL)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"distortion_model": "omni"}, "one of plumb_bob"),
        ({"distortion_model": ""}, "one of plumb_bob"),
        ({"k": np.zeros(9)}, "uncalibrated"),
        ({"k": np.full(9, np.nan)}, "finite"),
        ({"k": np.zeros(4)}, "9 entries"),
        ({"d": np.zeros(5)}, "takes 4 distortion coefficients"),
        ({"d": [np.inf, 0, 0, 0]}, "finite"),
        ({"width": 0}, "at least 1x1"),
        ({"binning_x": 2, "binning_y": 2}, "binned"),
        ({"roi": SimpleNamespace(x_offset=8, y_offset=0)}, "whole image"),
    ],
)
def test_camera_info_that_cannot_be_used_is_refused(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(PerceptionError, match=reason):
        camera_from_info(info(**changes))


def test_a_field_of_view_must_be_possible() -> None:
    with pytest.raises(PerceptionError, match="rad"):
        EquiangularCamera(1280, 720, field_azimuth=0.0)
