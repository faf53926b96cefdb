"""Time offset, pivoting, the turned scope and its notch, on motion and pictures made up here."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import angle_between, from_vector, inverse, rigid
from knee_gap_perception.calibrate.measurements.image_motion import ImageMotion, image_motion
from knee_gap_perception.calibrate.measurements.pose_track import PoseTrack
from knee_gap_perception.calibrate.observations import common_angle, still_stamps
from knee_gap_perception.calibrate.solvers.pivot import calibrate_pivot
from knee_gap_perception.calibrate.solvers.time_offset import estimate_time_offset
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.scope_rotation.notch import find_notch
from knee_gap_perception.scope_rotation.shaft_axis import (
    Mount,
    ShaftAxis,
    about,
    roll,
    rotated_lens,
    rotation_between,
    shaft_axis,
)

START_NS = 1_700_000_000_000_000_000


def hand(time: float, seed: int = 1) -> Array:
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3.5, (6, 6)), rng.uniform(0, 6, (6, 6))
    value = np.sin(2 * np.pi * frequency * time + phase).sum(axis=0) * np.repeat([0.02, 0.001], 3)
    return from_vector([0.3, 0.1, -0.2, 0.1, 0.9, 0.2]) @ from_vector(value)


def track(seconds: float = 18.0, seed: int = 1) -> PoseTrack:
    rng = np.random.default_rng(seed + 50)
    times = np.arange(-1, seconds + 1, 1 / 120)
    noise = np.repeat([np.radians(0.004), 0.0367e-3], 3) / np.sqrt(3)
    poses = np.array([hand(t, seed) @ from_vector(noise * rng.standard_normal(6)) for t in times])
    return PoseTrack.of(START_NS + np.round(times * 1e9).astype(np.int64), poses)


def flow(offset: float, seed: int = 1, seconds: float = 18.0, noise: float = 2e-4) -> ImageMotion:
    """An affine flow whose dependence on the body's motion drifts, as the scene's depth does."""
    rng = np.random.default_rng(seed + 90)
    times = np.arange(0, seconds, 1 / 30)
    base, drift = rng.standard_normal((2, 6, 6)) * np.repeat([1.0, 30.0], 3)
    moved = []
    for first, second in pairwise(times):
        step = inverse(hand(first + offset, seed)) @ hand(second + offset, seed)
        twist = np.concatenate([cv2.Rodrigues(step[:3, :3])[0].ravel(), step[:3, 3]])
        moved.append((base + drift * 0.3 * np.sin(0.7 * first)) @ twist)
    stamps = START_NS + np.round(times * 1e9).astype(np.int64)
    return ImageMotion(
        stamps[:-1], stamps[1:], np.array(moved) + noise * rng.standard_normal((len(moved), 6))
    )


@pytest.mark.parametrize(("offset", "seed"), [(0.012, 1), (-0.0317, 2), (0.11, 4)])
def test_time_offset_is_found_within_a_millisecond(offset: float, seed: int) -> None:
    found = estimate_time_offset(flow(offset, seed), track(seed=seed), max_offset=abs(offset) + 0.04)
    assert abs(found.offset - offset) < 1e-3
    assert abs(found.offset - offset) < 4 * found.sigma + 5e-5
    assert found.explained > 0.9


def test_pictures_that_do_not_move_with_the_body_are_refused() -> None:
    with pytest.raises(PerceptionError, match="times better than at other offsets"):
        estimate_time_offset(flow(0.0, seed=5), track(seed=6), max_offset=0.1)


def test_a_short_recording_is_refused() -> None:
    with pytest.raises(PerceptionError, match="record 15 s"):
        estimate_time_offset(flow(0.0, seconds=6), track())


def test_an_offset_beyond_the_search_is_refused() -> None:
    with pytest.raises(PerceptionError, match="edge of the search"):
        estimate_time_offset(flow(0.12), track(), max_offset=0.12)


def test_time_offset_of_motion_in_bursts_that_fill_windows_at_one_phase_only() -> None:
    moving = flow(0.01, seconds=44)
    burst = (moving.start_ns - moving.start_ns[0]) % int(4e9) < int(1.5e9)
    pairs = ImageMotion(moving.start_ns[burst], moving.end_ns[burst], moving.flow[burst])
    found = estimate_time_offset(pairs, track(seconds=60), max_offset=0.05)
    assert abs(found.offset - 0.01) < 4 * found.sigma


def test_image_motion_of_a_known_affine_map() -> None:
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (720, 1280)).astype(np.float32), (0, 0), 3)
    texture = 60 + 190 * (texture - texture.min()) / np.ptp(texture)
    disc = np.hypot(*(np.indices((720, 1280)) - np.array([359.5, 639.5])[:, None, None])) < 330
    centre = np.array([639.5, 359.5])
    A = np.array([[1.01, -0.02], [0.015, 0.99]])
    shift = np.array([4.0, -3.0])
    matrix = np.column_stack([A, centre + shift - A @ centre])
    pictures = [texture, cv2.warpAffine(texture, matrix, (1280, 720))]
    images = [np.repeat((p * disc).astype(np.uint8)[..., None], 3, axis=2) for p in pictures]
    found = image_motion([(START_NS, images[0]), (START_NS + 33_000_000, images[1])])
    assert found.flow.shape == (1, 6)
    radius = 330
    assert found.flow[0, :2] * radius == pytest.approx(shift, abs=0.15)
    assert found.flow[0, 2:].reshape(2, 2) == pytest.approx(A - np.eye(2), abs=1.5e-3)


def test_a_pose_track_bridges_no_gap_and_has_no_delay() -> None:
    whole = track()
    time = START_NS + 7_123_456_789
    assert np.linalg.norm(whole.at(time)[:3, 3] - hand(7.123456789)[:3, 3]) < 0.06e-3
    assert angle_between(whole.at(time), hand(7.123456789)) < np.radians(0.01)
    stamps = whole.stamps_ns[(whole.stamps_ns < START_NS + 3e9) | (whole.stamps_ns > START_NS + 4e9)]
    holed = PoseTrack.of(stamps, whole.at(stamps))
    assert holed.covers([START_NS + 2_000_000_000, START_NS + 3_500_000_000]).tolist() == [True, False]


def test_the_stillest_images_are_taken() -> None:
    whole = track()
    stamps = START_NS + (np.arange(540) * 1e9 / 30).astype(np.int64)
    chosen = still_stamps(stamps, 20, whole, 0.0)
    assert len(chosen) == 20
    speeds = [np.linalg.norm(whole.twist_rates(s)[:, :3], axis=1).mean() for s in (chosen, stamps)]
    assert speeds[0] < 0.7 * speeds[1]


def swinging(tip: Array, pivot: Array, count: int = 900, angle: float = 0.3, seed: int = 1) -> Array:
    rng = np.random.default_rng(seed)
    poses = []
    for phase in np.linspace(0, 20, count):
        R = cv2.Rodrigues(
            np.array([angle * np.sin(phase), angle * np.cos(1.3 * phase), 0.2 * np.sin(0.4 * phase)])
        )[0]
        poses.append(rigid(R, pivot - R @ tip + 0.05e-3 * rng.standard_normal(3)))
    return np.array(poses)


def test_pivoting_finds_the_tip_within_its_uncertainty() -> None:
    tip, pivot = np.array([0.003, -0.012, 0.201]), np.array([0.2, 1.0, -0.4])
    distances = []
    for seed in range(10):
        found = calibrate_pivot(swinging(tip, pivot, seed=seed))
        assert np.linalg.norm(found.tip - tip) < 0.1e-3
        assert found.rms == pytest.approx(0.05e-3 * np.sqrt(3), rel=0.1)
        distances.append((found.tip - tip) @ np.linalg.solve(found.covariance, found.tip - tip))
    assert np.median(distances) < 7.8  # 95 % of 3 degrees of freedom


def test_slips_of_the_tip_are_left_out() -> None:
    tip, pivot = np.array([0.003, -0.012, 0.201]), np.array([0.2, 1.0, -0.4])
    poses = swinging(tip, pivot)
    poses[100:120, :3, 3] += 0.004
    found = calibrate_pivot(poses)
    assert found.outlier_count >= 20
    assert np.linalg.norm(found.tip - tip) < 0.1e-3


def test_pivoting_without_rotation_is_refused() -> None:
    poses = swinging(np.array([0, 0, 0.2]), np.zeros(3), angle=0.02)
    with pytest.raises(PerceptionError, match="pivoting needs rotation"):
        calibrate_pivot(poses)
    with pytest.raises(PerceptionError, match="too few"):
        calibrate_pivot(poses[:10])


def test_turning_a_straight_scope_does_nothing() -> None:
    """With the shaft along the view, turning tip and picture alike leaves every direction where it was."""
    lens = from_vector([0.2, -0.1, 0.3, 0.01, 0.02, 0.2])
    axis = ShaftAxis(lens[:3, 2], lens[:3, 3])
    assert rotated_lens(lens, 0.8, Mount.CAMERA_HEAD, axis) == pytest.approx(lens, abs=1e-12)


def test_turning_an_oblique_scope_moves_its_view_around_a_cone() -> None:
    shaft = from_vector([0.2, -0.1, 0.3, 0.01, 0.02, 0.2])
    lens = shaft @ from_vector([np.radians(30), 0, 0, 0, 0, 0])
    axis = ShaftAxis(shaft[:3, 2], shaft[:3, 3])
    for turn in (0.5, np.pi):
        turned = rotated_lens(lens, turn, Mount.CAMERA_HEAD, axis)
        assert turned[:3, 2] @ axis.direction == pytest.approx(np.cos(np.radians(30)))
        assert turned[:3, :3] @ about([0, 0, 1], turn)[:, 0] == pytest.approx(
            about(axis.direction, turn) @ lens[:3, 0]
        )
    opposite = rotated_lens(lens, np.pi, Mount.CAMERA_HEAD, axis)
    assert np.degrees(np.arccos(opposite[:3, 2] @ lens[:3, 2])) == pytest.approx(60.0)


def test_a_body_on_the_scope_only_sees_the_picture_turn() -> None:
    lens = from_vector([0.2, -0.1, 0.3, 0.01, 0.02, 0.2])
    assert rotated_lens(lens, 0.4, Mount.SCOPE, None) == pytest.approx(lens @ roll(-0.4))
    with pytest.raises(PerceptionError, match="axis is not calibrated"):
        rotated_lens(lens, 0.4, Mount.CAMERA_HEAD, None)
    with pytest.raises(PerceptionError, match="not known"):
        rotated_lens(lens, float("nan"), Mount.SCOPE, None)


def test_a_second_body_tells_axis_and_turn() -> None:
    axis = ShaftAxis(np.array([0.6, 0.0, 0.8]), np.array([0.01, 0.02, 0.0]))
    first = from_vector([0.3, 0.2, 0.1, 0.05, 0.01, 0.02])
    turns = np.linspace(-0.7, 0.8, 20)
    poses = np.array([axis.turned(turn) @ first for turn in turns])
    found, spread = shaft_axis(poses)
    assert found.direction == pytest.approx(axis.direction)
    assert np.cross(found.direction, found.point - axis.point) == pytest.approx(0, abs=1e-9)
    assert spread == pytest.approx(1.5)
    assert [rotation_between(first, pose, found.direction) for pose in poses] == pytest.approx(turns)
    with pytest.raises(PerceptionError, match="at least 30 deg"):
        shaft_axis(poses[:4])


def picture(notch_angle: float | None, seed: int = 1) -> np.ndarray:  # type: ignore[type-arg]
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0:720, 0:1280]
    x, y = columns - 645.0, rows - 358.0
    radius, angle = np.hypot(x, y) / 355.0, np.arctan2(y, x)
    light = 130 + 60 * np.cos(5 * angle) + 10 * rng.standard_normal(radius.shape)
    reach = np.ones_like(radius)
    if notch_angle is not None:
        away = np.abs((angle - notch_angle + np.pi) % (2 * np.pi) - np.pi)
        reach -= 0.05 * np.clip(1 - away / np.radians(2.5), 0, 1)
    image = np.where(radius < reach, light, 2)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


FIELD = FieldOfView((645.3, 357.8), 355.4, (-0.5, -0.5, 1279.5, 719.5))


@pytest.mark.parametrize("degrees", [-179.5, -100.0, -30.0, 0.0, 77.7, 150.0])
def test_the_notch_is_found_to_a_fraction_of_a_degree(degrees: float) -> None:
    found = find_notch(picture(np.radians(degrees)), FIELD)
    assert found is not None
    assert abs((np.degrees(found.angle) - degrees + 180) % 360 - 180) < 0.25
    assert found.depth > 0.02


def test_no_notch_is_made_up() -> None:
    assert find_notch(picture(None), FIELD) is None
    assert find_notch(np.zeros((720, 1280, 3), np.uint8), FIELD) is None
    two = np.minimum(picture(0.3), picture(2.3))
    assert find_notch(two, FIELD) is None


def test_common_angle_wraps() -> None:
    angles = np.radians([179.5, -179.8, 179.9, 20.0, np.nan])
    assert abs(abs(np.degrees(common_angle(angles, np.radians(3)))) - 179.9) < 0.2
    assert np.isnan(common_angle(np.array([np.nan]), 0.1))
