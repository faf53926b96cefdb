"""The calibration's file: round trip, hash, refusals; what the lens's error does to two views."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knee_gap_core.values.rigid_transforms import from_vector, to_vector
from knee_gap_perception.calibrate.solvers.lens_error import lens_covariance, lens_errors
from knee_gap_perception.calibration import calibration_file
from knee_gap_perception.calibration.calibration import Calibration, Clock, LensOnBody, Oblique, Tip
from knee_gap_perception.calibration.calibration_file import load_calibration, require_place, save_calibration
from knee_gap_perception.calibration.in_use import CalibrationParameters
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis


def covariance(size: int, scale: float) -> np.ndarray:  # type: ignore[type-arg]
    A = np.random.default_rng(size).standard_normal((size, size)) * scale
    return A @ A.T


CAMERA = Intrinsics(
    1280, 720, "equidistant", (452.1, 0.0, 646.2, 0.0, 452.4, 358.7, 0.0, 0.0, 1.0), (1e-3, -2e-3, 0.0, 0.0),
    covariance(8, 0.02), 0.06, 0.04, 1.2, 48, 3489,
)  # fmt: skip
LENS = LensOnBody(
    np.array([0.0035, -0.012, 0.2031]), np.array([0.24, -0.02, -0.03, np.sqrt(1 - 0.0589)]),
    covariance(6, 1e-5), Mount.CAMERA_HEAD, 7e-5, 3.7e-5, 0.4, 48,
)  # fmt: skip
OBLIQUE = Oblique(-0.56, ShaftAxis(np.array([0.0, 0.6, 0.8]), np.array([0.003, -0.012, 0.1])), 5e-5, 4e-6)
WHOLE = Calibration(
    1280,
    720,
    CAMERA,
    LENS,
    OBLIQUE,
    Tip(np.array([0.0035, -0.012, 0.2043]), covariance(3, 1e-6), 4e-5),
    Clock(-0.01198, 6e-5, "board"),
)


def test_a_calibration_comes_back_as_it_was_written(tmp_path: Path) -> None:
    save_calibration(WHOLE, tmp_path / "scope.yaml")
    back = load_calibration(tmp_path / "scope.yaml")
    assert back.hash == WHOLE.hash
    assert back.camera is not None
    assert back.camera.covariance == pytest.approx(CAMERA.covariance)
    assert back.body_to_lens(0.4) == pytest.approx(WHOLE.body_to_lens(0.4))
    assert back.clock == WHOLE.clock


def test_parts_may_be_missing(tmp_path: Path) -> None:
    save_calibration(Calibration(640, 480), tmp_path / "scope.yaml")
    back = load_calibration(tmp_path / "scope.yaml")
    with pytest.raises(PerceptionError, match="calibrate intrinsics"):
        back.require_camera()
    with pytest.raises(PerceptionError, match="calibrate hand_eye"):
        back.body_to_lens()
    with pytest.raises(PerceptionError, match="calibrate oblique"):
        back.scope_rotation(0.1)


def test_the_hash_tells_any_change() -> None:
    changed = [
        replace(WHOLE, width_px=1281),
        replace(WHOLE, camera=replace(CAMERA, d=(1.0000001e-3, -2e-3, 0.0, 0.0))),
        replace(WHOLE, lens=replace(LENS, translation=LENS.translation * (1 + 1e-9))),
        replace(WHOLE, tip=None),
    ]
    assert len({WHOLE.hash, *(other.hash for other in changed)}) == 5


def test_a_file_changed_by_hand_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scope.yaml"
    save_calibration(WHOLE, path)
    path.write_text(path.read_text().replace("0.2031", "0.2032"))
    with pytest.raises(PerceptionError, match="does not match its hash"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [", "is not a YAML file"),
        ("a: 1", "is not a calibration"),
        ("format: knee_gap_calibration 1\nimage: 3", "malformed"),
        ("format: knee_gap_calibration 1\nhash: abc", "'image' is missing"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "scope.yaml"
    path.write_text(text)
    with pytest.raises(PerceptionError, match=reason):
        load_calibration(path)
    with pytest.raises(PerceptionError, match="cannot be read"):
        load_calibration(tmp_path / "missing.yaml")


NAN, BIG = float("nan"), float("inf")


def with_right_hash(calibration: Calibration, path: Path) -> Path:
    """A file as `calibrate` would write it, of numbers that it never would."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration_file, "broken_rule", lambda _: "")
        save_calibration(calibration, path)
    return path


def lens(**changes: Any) -> Calibration:
    return replace(WHOLE, lens=replace(LENS, **changes))


def camera(**changes: Any) -> Calibration:
    return replace(WHOLE, camera=replace(CAMERA, **changes))


def changed(covariance: np.ndarray, *places: tuple[int, int], value: float) -> np.ndarray:  # type: ignore[type-arg]
    result = covariance.copy()
    for place in places:
        result[place] = value
    return result


@pytest.mark.parametrize(
    ("calibration", "reason"),
    [
        (lens(covariance=LENS.covariance * NAN), "lens: the covariance has entries that are not finite"),
        (lens(covariance=-LENS.covariance), "lens: the covariance has a variance that is not above 0"),
        (lens(covariance=np.zeros((6, 6))), "lens: the covariance has a variance that is not above 0"),
        (lens(covariance=LENS.covariance * BIG), "not finite"),
        (lens(covariance=changed(LENS.covariance, (1, 2), value=1.0)), "is not symmetric"),
        (
            lens(covariance=changed(LENS.covariance, (1, 2), (2, 1), value=1e-3)),
            "is not positive semidefinite",
        ),
        (lens(quaternion_xyzw=np.zeros(4)), "the quaternion must have length 1, not 0"),
        (lens(quaternion_xyzw=LENS.quaternion_xyzw * 2), "the quaternion must have length 1, not 2"),
        (lens(quaternion_xyzw=LENS.quaternion_xyzw * NAN), "the quaternion must have length 1, not nan"),
        (lens(translation=LENS.translation * NAN), "the translation must be finite"),
        (lens(rotation_error=NAN), "errors must be finite"),
        (lens(translation_error=-1e-5), "errors must be finite and not negative"),
        (replace(WHOLE, clock=Clock(NAN, 6e-5, "board")), "clock: the offset must lie within 10 s, not nan"),
        (replace(WHOLE, clock=Clock(0.0, NAN, "board")), "clock: the standard error must be finite"),
        (replace(WHOLE, clock=Clock(0.0, 0.0, "board")), "above 0 s, not 0 s"),
        (replace(WHOLE, clock=Clock(0.0, -1e-5, "board")), "above 0 s, not -1e-05 s"),
        (replace(WHOLE, clock=Clock(1e9, 1e-5, "board")), "clock: the offset must lie within"),
        (camera(covariance=np.zeros((8, 8))), "camera: the covariance has a variance that is not above 0"),
        (camera(covariance=CAMERA.covariance * NAN), "camera: the covariance has entries"),
        (camera(k=(NAN, *CAMERA.k[1:])), "camera: k must be 9 finite numbers"),
        (camera(k=(-452.1, *CAMERA.k[1:])), "camera: focal lengths must be above 0 px"),
        (camera(d=(NAN, 0.0, 0.0, 0.0)), "camera: k must be 9 finite numbers, and d finite"),
        (camera(distortion_model="thin_air"), "camera: the distortion model must be one of"),
        (camera(rms_px=NAN), "camera: rms_px"),
        (replace(WHOLE, tip=Tip(np.zeros(3), np.zeros((3, 3)), 1e-5)), "tip: the covariance has a variance"),
        (replace(WHOLE, tip=Tip(np.full(3, NAN), np.eye(3), 1e-5)), "tip: position and rms must be finite"),
        (
            replace(WHOLE, oblique=replace(OBLIQUE, axis_tilt_sigma=0.0)),
            "oblique: the errors of the axis",
        ),
        (replace(WHOLE, oblique=replace(OBLIQUE, notch_angle=BIG)), "oblique: the notch's angle"),
        (
            replace(WHOLE, oblique=replace(OBLIQUE, T_head_scope=np.zeros((4, 4)))),
            "T_head_scope is not a rotation",
        ),
        (replace(WHOLE, width_px=0), "the image's size must lie in"),
    ],
)
def test_a_right_hash_over_wrong_numbers_is_refused(
    tmp_path: Path, calibration: Calibration, reason: str
) -> None:
    path = with_right_hash(calibration, tmp_path / "scope.yaml")
    with pytest.raises(PerceptionError, match=reason) as refusal:
        load_calibration(path)
    assert "\n" not in str(refusal.value)
    with pytest.raises(PerceptionError, match=reason):
        save_calibration(calibration, tmp_path / "other.yaml")
    assert not (tmp_path / "other.yaml").exists()


def test_terms_of_the_lens_that_were_not_fitted_have_no_variance(tmp_path: Path) -> None:
    fixed = CAMERA.covariance.copy()
    fixed[6:], fixed[:, 6:] = 0.0, 0.0
    save_calibration(camera(covariance=fixed), tmp_path / "scope.yaml")
    back = load_calibration(tmp_path / "scope.yaml").camera
    assert back is not None
    assert np.diagonal(back.covariance)[6:] == pytest.approx([0.0, 0.0])
    fixed[6, 0] = 1e-3
    with pytest.raises(PerceptionError, match="has a covariance with an unknown of no variance"):
        save_calibration(camera(covariance=fixed), tmp_path / "scope.yaml")


@pytest.mark.parametrize("text", ["[" * 100_000, "- " * 100_000, "a: &x [*x]", "\x00"])
def test_a_hostile_file_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scope.yaml"
    path.write_text(text)
    with pytest.raises(PerceptionError, match=r"scope\.yaml is not a YAML file") as refusal:
        load_calibration(path)
    assert "\n" not in str(refusal.value)


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(PerceptionError, match="is a FIFO, not a file"):
        load_calibration(tmp_path / "fifo")
    with pytest.raises(PerceptionError, match="is a device, not a file"):
        load_calibration(Path("/dev/zero"))
    with pytest.raises(PerceptionError, match="there is no such user"):
        CalibrationParameters(calibration_file="~nosuchuser_at_all/scope.yaml").load()


def test_no_place_for_a_calibration_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    os.mkfifo(tmp_path / "fifo")
    for place in (tmp_path / "link", tmp_path / "fifo", tmp_path, tmp_path / "nowhere" / "scope.yaml"):
        with pytest.raises(PerceptionError, match="name a file in a writable folder"):
            require_place(place)
    require_place(tmp_path / "new.yaml")


def test_images_of_another_size_are_refused() -> None:
    WHOLE.require_image_size(1280, 720)
    with pytest.raises(PerceptionError, match="made for images of 1280x720 px, not 1920x1080"):
        WHOLE.require_image_size(1920, 1080)
    with pytest.raises(PerceptionError, match="1280x720"):
        WHOLE.with_parts(640, 480, tip=None)


def test_the_tracking_node_gets_the_same_lens() -> None:
    parameters = TrackingParameters(**WHOLE.tracking_parameters())  # type: ignore[arg-type]
    assert parameters.body_to_lens() == pytest.approx(WHOLE.body_to_lens())


def test_the_notch_tells_the_turn() -> None:
    assert WHOLE.scope_rotation(-0.56 + 0.3) == pytest.approx(0.3)
    assert WHOLE.scope_rotation(np.pi - 0.1) == pytest.approx(np.pi - 0.1 + 0.56 - 2 * np.pi)


def test_pure_travel_does_not_feel_where_the_lens_sits() -> None:
    exact = replace(LENS, rotation_error=0.0, translation_error=0.0)
    first = from_vector([0.3, 0.2, 0.1, 0, 0, 0])
    along = first.copy()
    along[:3, 3] += [0.008, 0, 0]
    assert lens_errors(first, along, exact)[0] == pytest.approx(0.0, abs=1e-12)
    turned = first @ from_vector([0.2, 0, 0, 0.008, 0, 0])
    assert lens_errors(first, turned, exact)[0] > 1e-7


def test_the_covariance_of_a_baseline_is_that_of_many_calibrations() -> None:
    rng = np.random.default_rng(3)
    first, second = from_vector([0.3, 0.2, 0.1, 0, 0, 0]), from_vector([0.1, -0.2, 0.3, 0.05, 0.02, 0.01])
    errors = rng.multivariate_normal(np.zeros(6), LENS.covariance, 4000)
    noise = np.repeat([LENS.rotation_error, LENS.translation_error], 3) / np.sqrt(3)
    moved = []
    for error in errors:
        ends = [
            T @ from_vector(noise * rng.standard_normal(6)) @ LENS.T_body_lens @ from_vector(error)
            for T in (first, second)
        ]
        moved.append(ends[1][:3, 3] - ends[0][:3, 3])
    position, _ = lens_covariance(first, second, LENS)
    # Independent at each of the two views, and the common part twice a half.
    tracker, _ = lens_covariance(first, first, LENS)
    expected = 2 * tracker + 4 * (position - lens_covariance(second, second, LENS)[0])
    assert np.sqrt(np.trace(np.cov(np.array(moved).T))) == pytest.approx(
        np.sqrt(np.trace(expected)), rel=0.05
    )
    assert to_vector(LENS.T_body_lens)[3:] == pytest.approx(LENS.translation)
