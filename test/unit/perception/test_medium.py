"""Cameras in another medium: the law of refraction by a ray-trace of its own, and what it does not know."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.calibration.calibration_file import load_calibration, save_calibration
from knee_gap_perception.calibration.in_use import CalibrationParameters
from knee_gap_perception.camera.bearing_errors import BearingErrors
from knee_gap_perception.camera.camera import Camera, bearing_jacobian
from knee_gap_perception.camera.camera_errors import MOST_ERRORS, NEAR, PUPIL_DEPTH, CameraErrors, pupil_shift
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.medium import AIR, SALINE, WATER, Medium, medium_of
from knee_gap_perception.camera.models import EquiangularCamera, FisheyeCamera, PinholeCamera
from knee_gap_perception.camera.refraction import RefractedCamera, camera_in_medium
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import CameraInfoParameters
from knee_gap_perception.errors import PerceptionError

GLASS = 1.77  # a window of sapphire
BARREL = (-0.15, 0.02, 0.001, -0.0008, -0.001)
CAMERAS: dict[str, Camera] = {
    "equiangular": EquiangularCamera(1280, 720),
    "pinhole": PinholeCamera(1280, 720, 900.0, 905.0, 645.0, 352.0),
    "distorted pinhole": PinholeCamera(1280, 720, 900.0, 905.0, 645.0, 352.0, BARREL),
    "equidistant": FisheyeCamera(1280, 720, 458.4, 458.4, 640.0, 360.0),
    "fisheye": FisheyeCamera(1280, 720, 458.4, 450.1, 640.0, 360.0, (0.02, -0.01, 0.004, -0.001)),
}


def grid() -> Array:
    """Pixels (n, 2) in the disc that an endoscope shows."""
    u, v = np.meshgrid(np.linspace(300, 980, 18), np.linspace(20, 700, 18))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    return np.asarray(pixels[np.hypot(pixels[:, 0] - 640, pixels[:, 1] - 360) < 340])


def bent(direction: Array, normal: Array, before: float, after: float) -> Array:
    """A ray (3,) after a surface, by its angles of incidence and refraction in the plane of both."""
    incidence = np.arccos(np.clip(direction @ normal, -1.0, 1.0))
    refraction = np.arcsin(before * np.sin(incidence) / after)
    axis = np.cross(normal, direction)
    if np.linalg.norm(axis) < 1e-15:
        return normal
    axis /= np.linalg.norm(axis)
    # The normal, turned towards the ray by the angle of refraction.
    return np.asarray(np.cos(refraction) * normal + np.sin(refraction) * np.cross(axis, normal))


def traced(direction: Array, before: float, after: float, normal: Array | None = None) -> Array:
    """A ray (3,) from a pupil through a plane-parallel window: two surfaces, one after the other."""
    axis = np.array([0.0, 0.0, 1.0]) if normal is None else normal
    return bent(bent(direction, axis, before, GLASS), axis, GLASS, after)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize(("calibrated_in", "use"), [(AIR, SALINE), (WATER, SALINE), (AIR, Medium(1.5))])
def test_a_camera_sees_what_a_traced_ray_meets(camera: Camera, calibrated_in: Medium, use: Medium) -> None:
    pixels = grid()
    converted = camera_in_medium(camera, calibrated_in.ratio_to(use))
    expected = [traced(ray, calibrated_in.index, use.index) for ray in camera.bearings(pixels)]
    np.testing.assert_allclose(converted.bearings(pixels), expected, atol=1e-12)
    np.testing.assert_allclose(converted.pixels(3.0 * np.array(expected)), pixels, atol=1e-6)


def test_the_papers_ninety_degrees_are_64_in_saline() -> None:
    camera = camera_in_medium(CAMERAS["equiangular"], AIR.ratio_to(SALINE))
    left, right = camera.bearings([[-0.5, 359.5], [1279.5, 359.5]])
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(63.9, abs=0.05)
    left, right = camera.bearings([[639.0, 359.5], [640.0, 359.5]])
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(0.0526, abs=1e-4)
    assert np.degrees(camera.radians_per_pixel([639.5, 359.5])) == pytest.approx(0.125 / 1.336, rel=1e-4)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_there_and_back_is_the_camera_itself(camera: Camera) -> None:
    back = RefractedCamera(RefractedCamera(camera, AIR.ratio_to(SALINE)), SALINE.ratio_to(AIR))
    through = RefractedCamera(RefractedCamera(camera, AIR.ratio_to(WATER)), WATER.ratio_to(SALINE))
    pixels = grid()
    np.testing.assert_allclose(back.bearings(pixels), camera.bearings(pixels), atol=1e-12)
    once = camera_in_medium(camera, AIR.ratio_to(SALINE))
    np.testing.assert_allclose(through.bearings(pixels), once.bearings(pixels), atol=1e-12)
    assert camera_in_medium(camera, SALINE.ratio_to(SALINE)) is camera


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_the_jacobian_is_that_of_the_converted_bearings(camera: Camera) -> None:
    converted = camera_in_medium(camera, AIR.ratio_to(SALINE))
    pixel, step = np.array([870.0, 250.0]), np.array([0.3, -0.2])
    moved = converted.bearings(pixel + step) - converted.bearings(pixel)
    np.testing.assert_allclose(moved, bearing_jacobian(converted, pixel) @ step, atol=2e-6)
    assert converted.radians_per_pixel(pixel) < camera.radians_per_pixel(pixel)


def test_rays_that_no_window_passes_are_outside_the_model() -> None:
    fisheye = CAMERAS["equidistant"]  # sees beyond 90 degrees
    into_saline = RefractedCamera(fisheye, AIR.ratio_to(SALINE))
    assert np.isnan(into_saline.bearings([640.0 + 458.4 * 1.6, 360.0])).all()
    assert np.isfinite(into_saline.bearings([640.0 + 458.4 * 1.55, 360.0])).all()
    # Beyond the critical angle, 48.5 degrees, nothing in saline is seen from air.
    assert np.isnan(into_saline.pixels([1.2, 0.0, 1.0])).all()
    for wrong in ([0.0, 0.0, 0.0], [0.1, 0.0, -1.0], [np.nan, 0.0, 1.0]):
        assert np.isnan(into_saline.pixels(wrong)).all()
    into_air = RefractedCamera(fisheye, SALINE.ratio_to(AIR))
    assert np.isnan(into_air.bearings([640.0 + 458.4 * 0.86, 360.0])).all()
    with pytest.raises(PerceptionError, match="above 0 and finite"):
        RefractedCamera(fisheye, 0.0)


COVARIANCE = np.diag([0.05**2, 0.05**2, 0.04**2, 0.04**2, 1e-8, 1e-8, 1e-8, 1e-8])
INTRINSICS = Intrinsics(
    1280, 720, "equidistant", (458.4, 0.0, 640.0, 0.0, 450.1, 360.0, 0.0, 0.0, 1.0),
    (0.02, -0.01, 0.004, -0.001), COVARIANCE, 0.1, 0.1, 1.0, 20, 1000,
)  # fmt: skip


def seen(rays: Array, medium: Medium, normal: Array | None = None, index: float | None = None) -> Array:
    """Rays (n, 3) of a calibration in air as they go on in a medium."""
    return np.array([traced(ray, 1.0, index or medium.index, normal) for ray in rays])


def test_the_columns_hold_what_a_window_may_do() -> None:
    """Indices, tilts and pupils of the stated size move traced rays by no more than the columns span."""
    camera = INTRINSICS.camera()
    in_use = camera_in_medium(camera, AIR.ratio_to(SALINE))
    pixels = grid()
    rays, bearings = camera.bearings(pixels), in_use.bearings(pixels)
    columns = CameraErrors(camera, [], AIR, SALINE).of(bearings)
    np.testing.assert_allclose(np.einsum("nik,ni->nk", columns, bearings), 0.0, atol=1e-5)
    for index in (1.330, 1.342):  # two standard errors
        moved = seen(rays, SALINE, index=index) - bearings
        np.testing.assert_allclose(np.abs(moved), 2.0 * np.abs(columns[..., 0]), atol=5e-5)
    for axis in (0, 1):
        normal = np.array([0.0, 0.0, 1.0])
        normal[axis] = np.tan(np.radians(0.5))
        moved = seen(rays, SALINE, normal / np.linalg.norm(normal)) - bearings
        np.testing.assert_allclose(moved, columns[..., 1 + axis], atol=5e-5)


def test_a_pupil_behind_the_window_is_a_shift_and_a_column() -> None:
    """A traced ray from a pupil behind the window against one that starts at the calibrated pupil."""
    camera = INTRINSICS.camera()
    pixels = grid()
    rays = camera.bearings(pixels)
    bearings = camera_in_medium(camera, AIR.ratio_to(SALINE)).bearings(pixels)
    column = CameraErrors(camera, [], AIR, SALINE).of(bearings)[..., 4]
    # Where the ray leaves the window (thin, its outer face at z = 0), and where it is NEAR the pupil.
    at_window = PUPIL_DEPTH * rays / rays[:, 2:] - [0.0, 0.0, PUPIL_DEPTH]
    points = at_window + NEAR * bearings
    shifted = np.array([0.0, 0.0, -PUPIL_DEPTH - pupil_shift(AIR, SALINE)])
    moved = (points - shifted) / np.linalg.norm(points - shifted, axis=1, keepdims=True) - bearings
    np.testing.assert_allclose(moved, column, atol=0.15 * np.abs(column).max())
    assert np.linalg.norm(column, axis=1).max() > np.radians(0.3)


def test_errors_of_the_cameras_numbers_go_through_the_window() -> None:
    """The columns of a calibrated camera are what its conversion does if a number is off by one sigma."""
    source = BearingErrors(INTRINSICS)
    camera, ratio = INTRINSICS.camera(), AIR.ratio_to(SALINE)
    pixels = grid()
    bearings = camera_in_medium(camera, ratio).bearings(pixels)

    class One:
        """The camera's errors alone, few enough to be given one by one."""

        def of(self, reported: Array) -> Array:
            return source.of(reported)[..., :3]

    columns = CameraErrors(camera, [One()], AIR, SALINE).of(bearings)
    before = source.of(camera.bearings(pixels))[..., :3]
    for k in range(3):
        moved = camera.bearings(pixels) + before[..., k]
        expected = seen(moved / np.linalg.norm(moved, axis=1, keepdims=True), SALINE) - bearings
        np.testing.assert_allclose(columns[..., k], expected, atol=1e-6)


def test_more_than_nine_errors_keep_their_variance() -> None:
    source = BearingErrors(INTRINSICS)
    camera = INTRINSICS.camera()
    bearings = camera_in_medium(camera, AIR.ratio_to(SALINE)).bearings(grid())
    window = CameraErrors(camera, [], AIR, SALINE).of(bearings)
    calibrated = camera.bearings(grid())
    both = CameraErrors(camera, [source], AIR, SALINE).of(bearings)
    assert source.of(calibrated).shape[-1] + window.shape[-1] > MOST_ERRORS
    assert both.shape[-1] == MOST_ERRORS
    # Sines of angles shrink by the index; cosines make the rest.
    alone = CameraErrors(camera, [source], AIR, AIR).of(calibrated)
    across = 1.0 / 1.336 * alone
    across[:, 2] = -(np.einsum("ni,nik->nk", bearings[:, :2], across[:, :2])) / bearings[:, 2:]
    separate = np.concatenate([across, window], axis=-1)
    for one, other in zip(both, separate, strict=True):
        spread = other @ other.T
        assert one @ one.T == pytest.approx(spread, abs=0.02 * np.trace(spread))


def test_in_one_medium_nothing_is_added() -> None:
    bearings = INTRINSICS.camera().bearings(grid())
    source = BearingErrors(INTRINSICS)
    for medium in (AIR, SALINE):
        same = CameraErrors(INTRINSICS.camera(), [source], medium, medium).of(bearings)
        assert same.tobytes() == source.of(bearings).tobytes()
        assert CameraErrors(INTRINSICS.camera(), [], medium, medium).of(bearings).shape == (
            len(bearings),
            3,
            0,
        )
    assert pupil_shift(SALINE, SALINE) == 0.0
    bath = CameraErrors(INTRINSICS.camera(), [source], SALINE, SALINE).of(bearings)
    table = CameraErrors(INTRINSICS.camera(), [source], AIR, SALINE).of(bearings)
    assert np.linalg.norm(table) > 3.0 * np.linalg.norm(bath)


def told_info(**changes: object) -> Any:
    fields = {"d": np.zeros(4), "k": np.array([458.4, 0, 640, 0, 458.4, 360, 0, 0, 1]), **changes}
    return SimpleNamespace(
        width=1280, height=720, distortion_model="equidistant", binning_x=0, binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False), **fields,
    )  # fmt: skip


def test_a_stream_converts_camera_info_and_a_calibration_alike() -> None:
    pixel, angle = [900.0, 360.0], []
    for made in (
        EdgeStream(),
        EdgeStream(medium=AIR),
        EdgeStream(camera_info_medium=SALINE),
        EdgeStream(calibration=Calibration(1280, 720, INTRINSICS)),
        EdgeStream(calibration=Calibration(1280, 720, INTRINSICS, medium=SALINE)),
    ):
        if made.calibration is None:
            made.on_camera_info(told_info())
        assert made._camera is not None
        angle.append(np.arcsin(made._camera.bearings(pixel)[0]))
    assert np.sin(angle[0]) == pytest.approx(np.sin(angle[1]) / 1.336)
    assert angle[1] == angle[2] == np.arcsin(camera_from_info(told_info()).bearings(pixel)[0])
    assert np.sin(angle[3]) == pytest.approx(np.sin(angle[4]) / 1.336)


def test_a_camera_info_of_another_medium_is_compared_in_that_of_use() -> None:
    stream = EdgeStream(calibration=Calibration(1280, 720, INTRINSICS, medium=SALINE))
    k, d = list(INTRINSICS.k), list(INTRINSICS.d)
    stream.on_camera_info(told_info(k=k, d=d))  # the same numbers, for air
    assert any("differs from the calibration by" in words for words in stream.counts)
    same = EdgeStream(
        calibration=Calibration(1280, 720, INTRINSICS, medium=SALINE), camera_info_medium=SALINE
    )
    same.on_camera_info(told_info(k=k, d=d))
    assert not same.counts


@pytest.mark.parametrize(("value", "index"), [("air", 1.0), ("saline", 1.336), ("1.34", 1.34), (1.4, 1.4)])
def test_media_have_names_and_indices(value: str | float, index: float) -> None:
    assert medium_of(value).index == index
    assert medium_of(medium_of(value).value) == medium_of(value)
    assert CalibrationParameters(medium=value).used_in.index == index
    assert CameraInfoParameters(camera_info_medium=value).calibrated_in.index == index


@pytest.mark.parametrize("value", ["", "beer", "nan", 0.9, 2.0, float("inf"), True, None])
def test_a_medium_that_there_is_not_is_refused_by_name(value: Any) -> None:
    with pytest.raises(PerceptionError, match=r"^medium must be air, saline, water or a refractive index"):
        CalibrationParameters(medium=value)
    with pytest.raises(PerceptionError, match="camera_info_medium must be"):
        CameraInfoParameters(camera_info_medium=value)


def test_the_file_keeps_the_medium_and_old_files_are_of_air(tmp_path: Any) -> None:
    plain = Calibration(1280, 720, INTRINSICS)
    for medium in (AIR, SALINE, Medium(1.345)):
        one = Calibration(1280, 720, INTRINSICS, medium=medium)
        save_calibration(one, tmp_path / "scope.yaml")
        back = load_calibration(tmp_path / "scope.yaml")
        assert back.medium == medium
        assert back.hash == one.hash
        assert ("medium" in (tmp_path / "scope.yaml").read_text()) is (medium != AIR)
        assert (one.hash == plain.hash) is (medium == AIR)
    text = (tmp_path / "scope.yaml").read_text().replace("medium: 1.345", "medium: beer")
    (tmp_path / "scope.yaml").write_text(text)
    with pytest.raises(PerceptionError, match="medium must be"):
        load_calibration(tmp_path / "scope.yaml")
