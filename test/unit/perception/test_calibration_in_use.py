"""A calibration in the tracker and in the edge stream: what it changes, and what it is refused for."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.poses import BodyPose, LensPose, rigid_transform
from knee_gap_perception.calibration.calibration import Calibration, Clock, LensOnBody, Oblique
from knee_gap_perception.calibration.calibration_file import save_calibration
from knee_gap_perception.calibration.in_use import CalibrationParameters
from knee_gap_perception.camera.agreement import disagreement
from knee_gap_perception.camera.bearing_errors import BearingErrors
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages_tracking import fill_scope_calibration
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis
from knee_gap_uncertainty.estimation.messages import calibration_from_message
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.scope_calibration.scope_calibration import shared_error

CAMERA = Intrinsics(
    64, 48, "equidistant", (40.0, 0.0, 32.0, 0.0, 40.0, 24.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0),
    np.eye(8) * 1e-4, 0.1, 0.1, 1.0, 20, 900,
)  # fmt: skip
TURN = np.array([0.24, -0.02, -0.03, np.sqrt(1 - 0.0589)])
LENS = LensOnBody(
    np.array([0.0035, -0.012, 0.2031]), TURN, np.diag([1e-8] * 3 + [4e-8] * 3), Mount.CAMERA_HEAD, 7e-5,
    3.7e-5, 0.4, 48,
)  # fmt: skip
SCOPE = Calibration(64, 48, CAMERA, LENS, clock=Clock(-0.012, 1e-5, "board"))
AXIS = ShaftAxis(np.array([0.0, 0.6, 0.8]), np.array([0.003, -0.012, 0.1]))
T_HEAD_SCOPE = rigid_transform([0.0, 0.03, 0.02], [0.0, 0.0, 0.0, 1.0])
TURNED = replace(SCOPE, oblique=Oblique(np.nan, AXIS, 5e-4, 4e-5, T_HEAD_SCOPE))


def body(k: int, name: str = "scope", T: Any = None) -> BodyPose:
    T = rigid_transform([0.1 + 1e-4 * k, 0.2, 0.3], [0.1, 0.0, 0.0, np.sqrt(0.99)]) if T is None else T
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return BodyPose(10**18 + k * 8_333_333, T[:3, 3], quaternion, name)


def test_the_lens_is_where_the_calibration_says_and_at_the_images_time() -> None:
    tracker = ScopeTracker(calibration=SCOPE)
    pose = body(0)
    lens = tracker.update(pose)
    assert isinstance(lens, LensPose)
    expected = rigid_transform(pose.position, pose.quaternion_xyzw) @ SCOPE.body_to_lens()
    np.testing.assert_allclose(lens.matrix(), expected, atol=1e-12)
    # The image that was exposed together with the pose is stamped 12 ms late.
    assert lens.stamp_ns == pose.stamp_ns + 12_000_000


def test_a_second_body_turns_the_lens_frame_by_frame() -> None:
    tracker = ScopeTracker(TrackingParameters(scope_rotation_body="post"), calibration=TURNED)
    variances = []
    for k in range(20):
        turn = 0.02 * k
        head = rigid_transform([0.1 + 1e-4 * k, 0.2, 0.3], [0.1, 0.0, 0.0, np.sqrt(0.99)])
        lens = tracker.update(body(k, T=head), [body(k, "post", head @ AXIS.turned(turn) @ T_HEAD_SCOPE)])
        assert isinstance(lens, LensPose)
        np.testing.assert_allclose(lens.matrix(), head @ TURNED.body_to_lens(turn), atol=1e-9)
        assert lens.scope_rotation == pytest.approx(turn)
        variances.append(np.trace(lens.covariance))
    # The further the scope is turned, the more the error of the shaft's axis counts.
    chord = 2 * np.sin(0.5 * turn)
    assert variances[-1] - variances[0] == pytest.approx(3 * chord**2 * (4e-5**2 + 5e-4**2))


def test_without_its_second_body_the_turn_is_not_known() -> None:
    tracker = ScopeTracker(TrackingParameters(scope_rotation_body="post"), calibration=TURNED)
    refusal = tracker.update(body(0))
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.NO_TURN
    assert "'post' on the scope is not in the frame" in refusal.detail


@pytest.mark.parametrize(
    ("parameters", "calibration", "words"),
    [
        ({"body_to_shaft_translation": (0.0, 0.0, 0.2)}, SCOPE, "body_to_shaft_translation: leave one"),
        ({"oblique_angle": 0.1}, SCOPE, "and in oblique_angle"),
        ({"scope_rotation_body": "post"}, None, "needs a calibration_file"),
        ({"scope_rotation_body": "post"}, SCOPE, "knows no second body"),
        ({}, TURNED, "name it in scope_rotation_body"),
        ({}, replace(SCOPE, lens=None), "run calibrate hand_eye"),
    ],
)
def test_contradictory_settings_are_refused(
    parameters: dict[str, Any], calibration: Calibration | None, words: str
) -> None:
    with pytest.raises(PerceptionError, match=words):
        ScopeTracker(TrackingParameters(**parameters), calibration=calibration)


def image(width: int, height: int) -> Any:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=10**9, nanosec=0), frame_id="arthroscope_optical")
    data = np.zeros(width * height * 3, np.uint8)
    return SimpleNamespace(
        header=header, width=width, height=height, encoding="bgr8", step=3 * width, data=data, is_bigendian=0
    )


def looked_at(stream: EdgeStream, message: Any) -> EdgeStatus:
    stream.on_image(message)
    return next(iter(stream.ready())).status


def test_images_of_another_size_are_refused_by_name() -> None:
    stream = EdgeStream(calibration=SCOPE)
    assert looked_at(stream, image(128, 96)) is EdgeStatus.UNKNOWN
    assert "made for images of 64x48 px, not 128x96 px" in stream.reason
    assert stream.size_flaw
    looked_at(stream, image(64, 48))  # no camera_info is needed
    assert "calibration" not in stream.reason
    assert "camera_info" not in stream.reason
    assert not stream.size_flaw


def test_a_stream_needs_the_calibrations_camera() -> None:
    with pytest.raises(PerceptionError, match="run calibrate intrinsics"):
        EdgeStream(calibration=replace(SCOPE, camera=None))


def test_a_camera_info_that_disagrees_is_counted() -> None:
    stream = EdgeStream(calibration=SCOPE)
    info = SimpleNamespace(
        width=64, height=48, distortion_model="equidistant", k=list(CAMERA.k), d=list(CAMERA.d),
        r=list(np.eye(3).ravel()), p=[0.0] * 12, binning_x=0, binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False),
    )  # fmt: skip
    stream.on_camera_info(info)
    assert not stream.counts
    info.k = [44.0, *CAMERA.k[1:4], 44.0, *CAMERA.k[5:]]
    stream.on_camera_info(info)
    assert any("differs from the calibration by" in words for words in stream.counts)
    assert not disagreement(CAMERA.camera(), CAMERA.camera())


def test_no_file_means_no_calibration_and_a_missing_one_is_told(tmp_path: Path) -> None:
    assert CalibrationParameters().load() is None
    with pytest.raises(PerceptionError, match="cannot be read"):
        CalibrationParameters(str(tmp_path / "none.yaml")).load()
    save_calibration(SCOPE, tmp_path / "scope.yaml")
    loaded = CalibrationParameters(str(tmp_path / "scope.yaml")).load()
    assert loaded is not None
    assert loaded.hash == SCOPE.hash


def test_what_is_told_of_it_arrives_in_the_order_of_rep_103() -> None:
    message = blank("knee_gap_msgs/msg/ScopeCalibration")
    reported = calibration_from_message(fill_scope_calibration(message, "tracking_node", SCOPE))
    assert reported.hash == SCOPE.hash
    assert reported.time_offset_error == 1e-5
    np.testing.assert_array_equal(np.diag(reported.lens_covariance), [4e-8] * 3 + [1e-8] * 3)
    assert shared_error([reported], EstimatorParameters()).clock == 1e-5
    message = blank("knee_gap_msgs/msg/ScopeCalibration")
    nothing = calibration_from_message(fill_scope_calibration(message, "tracking_node", None))
    assert nothing.hash == ""
    assert shared_error([nothing], EstimatorParameters()).clock == EstimatorParameters().clock_error


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("equidistant", (0.01, -0.02, 0.0, 0.0)), ("plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0))],
)
def test_a_bearing_moves_with_the_cameras_errors_as_one_of_a_wrong_camera(
    model: str, distortion: tuple[float, ...]
) -> None:
    rng, size = np.random.default_rng(4), 4 + len(distortion)
    root = rng.standard_normal((size, size)) * np.array([0.2] * 4 + [2e-3] * len(distortion))[:, None]
    root[-1] = 0.0  # a parameter that the fit did not change
    camera = Intrinsics(
        1280, 720, model, (460.0, 0.0, 640.0, 0.0, 461.0, 360.0, 0.0, 0.0, 1.0), distortion, root @ root.T,
        0.1, 0.1, 1.0, 20, 900,
    )  # fmt: skip
    pixels = np.array([[640.0, 200.0], [820.0, 420.0]])
    bearings = camera.camera().bearings(pixels)
    errors = BearingErrors(camera).of(bearings)
    assert errors.shape == (2, 3, size - 1)
    moved = []
    for column in root.T:
        parameters = camera.parameters + column
        k = (parameters[0], 0.0, parameters[2], 0.0, parameters[1], parameters[3], 0.0, 0.0, 1.0)
        wrong = replace(camera, k=k, d=tuple(parameters[4:]))
        moved.append(wrong.camera().bearings(pixels) - bearings)
    for n in range(2):
        shown = np.array([one[n] for one in moved])
        np.testing.assert_allclose(
            errors[n] @ errors[n].T, shown.T @ shown, atol=0.02 * np.trace(shown.T @ shown)
        )
