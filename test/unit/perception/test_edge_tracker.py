"""The gap found, its points chosen and followed; the same answer twice; bad input reported."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from endoscope_images import RIGID_ENDOSCOPE, rigid_endoscope
from recordings import RECORDED, origins
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_perception.camera.models import FisheyeCamera, PinholeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters

Travel = tuple[list[Array], list[Image]]

FRAME_NS = 33_333_333
POSITION_ERROR = 2.1e-5  # [m] an axis: the tracker's 0.0367 mm


def lens_pose(T: Array, rng: np.random.Generator) -> LensPose:
    covariance = np.diag([POSITION_ERROR**2] * 3 + [1e-10] * 3)
    position = T[:3, 3] + rng.normal(0, POSITION_ERROR, 3)
    return LensPose(0, "world", position, Rotation.from_matrix(T[:3, :3]).as_quat(), covariance)


def follow(joint: Any, travel: Travel, *, posed: bool) -> list[GapEdges]:
    detector = GapEdgeTracker()
    rng = np.random.default_rng(1)
    return [
        detector.process(k * FRAME_NS, image, joint.camera, lens_pose(T, rng) if posed else None)
        for k, (T, image) in enumerate(zip(*travel, strict=True))
    ]


@pytest.mark.parametrize("posed", [False, True], ids=["images alone", "with poses"])
def test_the_same_two_points_are_followed(joint: Any, travel: Travel, posed: bool) -> None:
    edges = follow(joint, travel, posed=posed)
    assert {e.status for e in edges} == {EdgeStatus.VALID}
    assert {e.track_id for e in edges} == {1}
    poses, _ = travel
    true = np.stack([joint.moved_pixels(poses[0], T, edges[0].pixels) for T in poses])
    assert np.linalg.norm(true[-1] - true[0], axis=-1).min() > 150  # [px]: the points did travel
    true_bearings = joint.camera.bearings(true)
    bearings = np.stack([e.bearings for e in edges])
    angle = np.arccos(np.clip((true_bearings * bearings).sum(axis=-1), -1, 1))
    bound = np.array([e.angular_error for e in edges])
    assert (angle <= bound[:, None]).all()
    assert np.degrees(np.sqrt((angle**2).mean())) < 0.15
    assert np.degrees(bound.max()) < 1.0


def test_points_lie_on_the_tissue_beside_the_gap(joint: Any, travel: Travel) -> None:
    edges = GapEdgeTracker().process(0, travel[1][0], joint.camera)
    points, in_gap = joint.cast(travel[0][0], edges.bearings)
    assert not in_gap.any()
    assert points[0, 1] * points[1, 1] < 0  # one on either side
    beside = np.abs(points[:, 1]) - 2.0e-3
    assert (beside > 0.1e-3).all()
    assert (beside < 0.7e-3).all()


def test_covariance_is_that_of_a_unit_vector_and_below_the_bound(joint: Any, travel: Travel) -> None:
    for e in follow(joint, travel, posed=True)[::10]:
        for bearing, covariance in zip(e.bearings, e.covariances, strict=True):
            np.testing.assert_allclose(covariance, covariance.T, atol=1e-18)
            values = np.linalg.eigvalsh(covariance)
            assert abs(values[0]) < 1e-3 * values[1]
            np.testing.assert_allclose(covariance @ bearing, 0, atol=1e-3 * values[1])
            assert np.sqrt(values[-1]) < e.angular_error


def test_the_same_images_give_the_same_bits(joint: Any, travel: Travel) -> None:
    for first, second in zip(
        follow(joint, travel, posed=True), follow(joint, travel, posed=True), strict=True
    ):
        assert first.bearings.tobytes() == second.bearings.tobytes()
        assert first.covariances.tobytes() == second.covariances.tobytes()
        assert (first.status, first.track_id, first.angular_error) == (
            second.status,
            second.track_id,
            second.angular_error,
        )


def test_mask_is_the_gap(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    detector.process(0, travel[1][0], joint.camera)
    camera = joint.camera
    u, v = np.meshgrid(np.arange(1280.0), np.arange(720.0))
    _, gap = joint.cast(travel[0][0], camera.bearings(np.stack([u, v], axis=-1)))
    inside = np.hypot(u - camera.cx, v - camera.cy) < 345
    mask = detector.gap_mask() > 0
    dice = 2 * (mask & gap & inside).sum() / ((mask & inside).sum() + (gap & inside).sum())
    assert dice > 0.97


def test_a_point_hidden_for_long_ends_the_track_and_a_new_one_has_a_new_name(
    joint: Any, travel: Travel
) -> None:
    detector = GapEdgeTracker()
    first = detector.process(0, travel[1][0], joint.camera)
    column, row = np.rint(first.pixels[0]).astype(int)
    for k in range(1, 30):
        image = travel[1][0].copy()
        image[row - 60 : row + 60, column - 60 : column + 60] = 120
        image[::7, ::7, 0] += np.uint8(k % 3)
        edges = detector.process(k * FRAME_NS, image, joint.camera)
        if edges.status is EdgeStatus.VALID and edges.track_id == 1:
            assert edges.angular_error >= first.angular_error
            assert k * FRAME_NS <= 0.7e9
    assert detector.process(30 * FRAME_NS, travel[1][1], joint.camera).track_id != 1


def test_a_point_that_leaves_the_field_is_told(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    T = np.eye(4)
    statuses = []
    for k in range(28):
        T[0, 3] += min(6e-5 * k, 5e-4)
        statuses.append(detector.process(k * FRAME_NS, joint.picture(T, 100 + k), joint.camera).status)
        if statuses[-1] is not EdgeStatus.VALID:
            break
    assert statuses[-1] is EdgeStatus.OUT_OF_VIEW
    assert "left the field" in detector.reason


def test_a_lamp_that_flickers_is_told_and_does_not_end_the_track(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    assert detector.process(0, travel[1][0], joint.camera).track_id == 1
    for k, (level, reason) in enumerate([(0, "dark"), (255, "overexposed")]):
        dark = np.full_like(travel[1][0], level)
        edges = detector.process((k + 1) * FRAME_NS, dark, joint.camera)
        assert (edges.status, edges.track_id) == (EdgeStatus.LOW_CONTRAST, 1)
        assert reason in detector.reason
        assert np.isnan(edges.bearings).all()
    again = detector.process(3 * FRAME_NS, travel[1][1], joint.camera)
    assert (again.status, again.track_id) == (EdgeStatus.VALID, 1)
    for k in range(4, 30):
        dark = np.full_like(travel[1][0], k % 2)
        assert detector.process(k * FRAME_NS, dark, joint.camera).status is EdgeStatus.LOW_CONTRAST
    assert detector.process(30 * FRAME_NS, travel[1][1], joint.camera).track_id == 2


def test_stamps_running_backwards_start_a_new_track(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    assert detector.process(10 * FRAME_NS, travel[1][0], joint.camera).track_id == 1
    assert detector.process(11 * FRAME_NS, travel[1][1], joint.camera).track_id == 1
    looped = detector.process(10 * FRAME_NS, travel[1][0], joint.camera)
    assert (looped.status, looped.track_id) == (EdgeStatus.VALID, 2)


def test_an_image_that_comes_twice_is_told_and_does_not_end_the_track(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker(first_track_id=7001)
    assert detector.process(10 * FRAME_NS, travel[1][0], joint.camera).track_id == 7001
    repeated = detector.process(10 * FRAME_NS, travel[1][0], joint.camera)
    assert repeated.status is EdgeStatus.UNKNOWN
    assert "stamp" in detector.reason
    assert detector.process(11 * FRAME_NS, travel[1][1], joint.camera).track_id == 7001


def test_starting_anew_forgets_a_click_where_no_gap_is(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    detector.choose_at([200.0, 40.0])
    assert detector.process(10 * FRAME_NS, travel[1][0], joint.camera).status is not EdgeStatus.VALID
    detector.restart()
    assert detector.process(11 * FRAME_NS, travel[1][1], joint.camera).status is EdgeStatus.VALID


def test_a_clicked_pixel_chooses_the_section(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    detector.process(0, travel[1][0], joint.camera)
    detector.choose_at([820.0, 360.0])
    edges = detector.process(FRAME_NS, travel[1][1], joint.camera)
    assert edges.track_id == 2
    np.testing.assert_allclose(edges.pixels[:, 0], 820.0, atol=110.0)


def test_frozen_video_is_told(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    statuses = [detector.process(k * FRAME_NS, travel[1][0], joint.camera).status for k in range(6)]
    assert statuses[0] is EdgeStatus.VALID
    assert set(statuses[3:]) == {EdgeStatus.UNKNOWN}
    assert "frozen" in detector.reason


def test_resolution_change_starts_a_new_track(joint: Any, travel: Travel) -> None:
    detector = GapEdgeTracker()
    detector.process(0, travel[1][0], joint.camera)
    large = cv2.resize(travel[1][1], (1920, 1080))
    misfit = detector.process(FRAME_NS, large, joint.camera)
    assert misfit.status is EdgeStatus.UNKNOWN
    assert "camera_info is for 1280x720" in detector.reason
    camera = FisheyeCamera(1920, 1080, 687.6, 687.6, 960.5, 540.5)
    edges = detector.process(2 * FRAME_NS, large, camera)
    assert (edges.status, edges.track_id) == (EdgeStatus.VALID, 2)


def noise(low: int, high: int) -> Image:
    return np.random.default_rng(0).integers(low, high, (720, 1280, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("image", "status", "reason"),
    [
        (np.zeros((720, 1280, 3), np.uint8), EdgeStatus.LOW_CONTRAST, "dark"),
        (np.full((720, 1280, 3), 255, np.uint8), EdgeStatus.LOW_CONTRAST, "overexposed"),
        (noise(100, 140), EdgeStatus.NO_GAP, "gap"),
        (noise(0, 12), EdgeStatus.LOW_CONTRAST, "dark"),
        (np.zeros((720, 1280, 3), np.uint16), EdgeStatus.UNKNOWN, "8 bits"),
        (np.zeros((720, 1280, 4), np.uint8), EdgeStatus.UNKNOWN, "8 bits"),
        (np.zeros((0, 0, 3), np.uint8), EdgeStatus.UNKNOWN, "64x64"),
        (np.zeros((0,), np.uint8), EdgeStatus.UNKNOWN, "8 bits"),
    ],
    ids=["black", "white", "even", "dark noise", "16 bits", "4 channels", "empty", "no image"],
)
def test_images_without_a_gap_are_told(image: Any, status: EdgeStatus, reason: str) -> None:
    detector = GapEdgeTracker()
    edges = detector.process(0, image, PinholeCamera(1280, 720, 600, 600, 640, 360))
    assert edges.status is status
    assert reason in detector.reason
    assert edges.track_id == 0
    assert np.isnan(edges.bearings).all()
    assert np.isnan(edges.angular_error)


def test_grey_images_serve(joint: Any, travel: Travel) -> None:
    grey = cv2.cvtColor(travel[1][0], cv2.COLOR_BGR2GRAY)
    assert GapEdgeTracker().process(0, grey, joint.camera).status is EdgeStatus.VALID


def test_parameters_are_checked() -> None:
    with pytest.raises(PerceptionError, match="segmentation must be one of otsu, otsu3"):
        EdgeParameters(segmentation="magic")
    with pytest.raises(PerceptionError, match="inset"):
        EdgeParameters(inset=1.0)
    with pytest.raises(PerceptionError, match="network_path"):
        EdgeParameters(segmentation="onnx")
    with pytest.raises(PerceptionError, match=r"no\.onnx"):
        GapEdgeTracker(EdgeParameters(segmentation="onnx", network_path="no.onnx"))
    with pytest.raises(PerceptionError, match="network_mean"):
        EdgeParameters(network_mean=(0.0,))


@pytest.mark.parametrize("origin", origins(RIGID_ENDOSCOPE))
def test_real_frames_never_raise(origin: str, tmp_path: Path) -> None:
    detector, statuses = GapEdgeTracker(), set()
    frames = rigid_endoscope(origin, tmp_path)
    for k, file in enumerate(frames.files):
        edges = detector.process(
            k * FRAME_NS, cv2.imread(str(file)), PinholeCamera(1920, 1080, *frames.pinhole)
        )
        statuses.add(edges.status)
        if edges.status is EdgeStatus.VALID:
            assert np.isfinite(edges.angular_error)
        else:
            assert detector.reason
    # What is drawn has a gap; whether the recorded one has is a matter of opinion.
    assert origin == RECORDED or EdgeStatus.VALID in statuses
