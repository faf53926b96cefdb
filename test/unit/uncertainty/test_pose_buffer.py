from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.errors import BadInputError
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.inputs.pose_buffer import PoseBuffer, PoseRefusal

PERIOD_NS = 8_333_333
START_NS = 1_700_000_000_000_000_000
AXIS = np.array([1.0, 2.0, -2.0]) / 3.0


def even_motion(stamp_ns, *, sign=1.0, **changes):
    """A lens that moves and turns evenly, so that interpolation has an exact answer."""
    t = (stamp_ns - START_NS) / 1e9
    values = {
        "stamp_ns": stamp_ns,
        "frame_id": "world",
        "position": np.array([0.01, -0.02, 0.05]) * t + 0.3,
        "quaternion_xyzw": sign * Rotation.from_rotvec(0.7 * t * AXIS).as_quat(),
        "covariance": np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-9,
    }
    return LensPose(**(values | changes))


def filled(count=40, **settings):
    buffer = PoseBuffer(**settings)
    for i in range(count):
        buffer.add(even_motion(START_NS + i * PERIOD_NS, sign=(-1.0) ** i))
    return buffer


def test_an_even_motion_is_met_exactly_whatever_the_sign_of_the_quaternions():
    buffer = filled()
    for stamp in np.random.default_rng(2).integers(START_NS, START_NS + 39 * PERIOD_NS, 200):
        pose, truth = buffer.at(int(stamp)), even_motion(int(stamp))
        assert isinstance(pose, LensPose)
        assert pose.stamp_ns == stamp
        np.testing.assert_allclose(pose.position, truth.position, atol=1e-13)
        difference = (
            Rotation.from_quat(pose.quaternion_xyzw) * Rotation.from_quat(truth.quaternion_xyzw).inv()
        )
        # START_NS + a fraction is exact in integers, not in the truth's float seconds.
        assert difference.magnitude() < 1e-9


def test_at_a_pose_it_is_that_pose():
    buffer = filled()
    truth = even_motion(START_NS + 7 * PERIOD_NS)
    pose = buffer.at(truth.stamp_ns)
    np.testing.assert_array_equal(pose.position, truth.position)
    np.testing.assert_array_equal(pose.covariance, truth.covariance)


def test_the_velocity_is_over_two_periods_so_that_the_trackers_noise_is_small_in_it():
    rng, sigma = np.random.default_rng(3), 2e-5
    buffer = PoseBuffer()
    for i in range(400):
        pose = even_motion(START_NS + i * PERIOD_NS)
        buffer.add(replace(pose, position=pose.position + sigma * rng.standard_normal(3)))
    off = []
    for i in range(3, 399, 3):
        for stamp in (START_NS + i * PERIOD_NS, START_NS + i * PERIOD_NS - 2_000_000):
            pose = buffer.at(stamp)
            assert isinstance(pose, LensPose)
            assert pose.motion_time == pytest.approx(2e-9 * PERIOD_NS)
            off.append(pose.motion - [0.01, -0.02, 0.05, *(0.7 * AXIS)])
    assert np.std(np.array(off)[:, :3]) == pytest.approx(np.sqrt(2.0) * sigma / (2e-9 * PERIOD_NS), rel=0.1)
    assert np.abs(np.array(off)[:, 3:]).max() < 1e-6


def test_a_velocity_over_a_longer_time_is_taken_where_poses_are_rare():
    buffer = PoseBuffer()
    # The tracker's period is known from its first poses.
    for i in range(-4, 4):
        buffer.add(even_motion(START_NS + i * 30_000_000))
    pose = buffer.at(START_NS + 70_000_000)
    assert isinstance(pose, LensPose)
    assert pose.motion_time == pytest.approx(0.03)
    np.testing.assert_allclose(pose.motion[:3], [0.01, -0.02, 0.05], rtol=1e-5)
    first = buffer.at(START_NS)
    assert isinstance(first, LensPose)
    assert first.motion_time == pytest.approx(0.03)
    np.testing.assert_allclose(first.motion[:3], [0.01, -0.02, 0.05], rtol=1e-5)


def test_no_velocity_is_taken_across_a_gap_in_the_poses():
    buffer = PoseBuffer(max_pose_age=0.02)
    stamps = [START_NS + ms * 1_000_000 for ms in (0, 30, 1000)]
    for stamp_ns in [*range(START_NS - 120_000_000, START_NS, 30_000_000), *stamps]:
        buffer.add(even_motion(stamp_ns))
    alone = buffer.at(stamps[2])
    assert isinstance(alone, LensPose)
    assert np.isnan(alone.motion).all()
    assert alone.motion_time == np.inf
    buffer.add(even_motion(stamps[2] + 30_000_000))
    followed = buffer.at(stamps[2])
    assert isinstance(followed, LensPose)
    assert followed.motion_time == pytest.approx(0.03)
    np.testing.assert_allclose(followed.motion[:3], [0.01, -0.02, 0.05], rtol=1e-4)


def test_interpolation_does_not_depend_on_the_frame():
    turn, shift = Rotation.from_euler("xyz", [20, 130, -70], degrees=True), np.array([3.0, -1.0, 2.0])
    here, there = PoseBuffer(), PoseBuffer()
    rng = np.random.default_rng(4)
    for i in range(2):
        position, rotation = rng.normal(size=3), Rotation.random(random_state=i)
        stamp = START_NS + i * PERIOD_NS
        here.add(even_motion(stamp, position=position, quaternion_xyzw=rotation.as_quat()))
        there.add(
            even_motion(
                stamp,
                position=turn.apply(position) + shift,
                quaternion_xyzw=(turn * rotation).as_quat(),
            )
        )
    stamp = START_NS + PERIOD_NS // 3
    first, second = here.at(stamp), there.at(stamp)
    np.testing.assert_allclose(turn.apply(first.position) + shift, second.position, atol=1e-12)
    difference = (turn * Rotation.from_quat(first.quaternion_xyzw)) * Rotation.from_quat(
        second.quaternion_xyzw
    ).inv()
    assert difference.magnitude() < 1e-12


def test_nothing_is_extrapolated():
    buffer = filled(max_pose_age=0.05)
    assert PoseBuffer().at(START_NS) is PoseRefusal.NOT_YET
    assert buffer.at(START_NS - 1) is PoseRefusal.TOO_OLD
    newest = START_NS + 39 * PERIOD_NS
    assert buffer.newest_stamp_ns == newest
    assert buffer.at(newest + 1) is PoseRefusal.NOT_YET


def test_both_enclosing_poses_must_be_near():
    buffer = PoseBuffer(max_pose_age=0.05)
    for i in range(-4, 1):
        buffer.add(even_motion(START_NS + i * 90_000_000))
    buffer.add(even_motion(START_NS + 90_000_000))
    assert isinstance(buffer.at(START_NS + 45_000_000), LensPose)
    assert isinstance(buffer.at(START_NS + 40_000_000), LensPose)
    assert buffer.at(START_NS + 39_999_999) is PoseRefusal.GAP
    assert buffer.at(START_NS + 50_000_001) is PoseRefusal.GAP


def test_memory_is_bounded_and_the_oldest_go_first():
    buffer = filled(1000, capacity=100)
    assert len(buffer) == 100
    assert buffer.at(START_NS + 899 * PERIOD_NS) is PoseRefusal.TOO_OLD
    assert isinstance(buffer.at(START_NS + 901 * PERIOD_NS - 5), LensPose)


def test_a_bag_that_starts_again_is_not_joined_to_its_end():
    buffer = filled()
    buffer.add(even_motion(START_NS + PERIOD_NS))
    assert buffer.reset_count == 1
    assert len(buffer) == 1
    assert buffer.at(START_NS + 20 * PERIOD_NS + 1) is PoseRefusal.NOT_YET


def test_the_same_stamp_twice_keeps_the_first():
    buffer = filled()
    newest = buffer.newest_stamp_ns
    assert buffer.add(even_motion(newest, position=np.full(3, 9.0))) is PoseRefusal.DUPLICATE
    assert len(buffer) == 40
    assert buffer.at(newest).position[0] < 1.0


def test_covariance_covers_a_hand_that_accelerates():
    """Monte Carlo: noisy poses of a lens under a random constant acceleration."""
    rng = np.random.default_rng(6)
    sigma, acceleration, turning = 1e-5, 2.0, 10.0
    half = 20_000_000
    errors = []
    for _ in range(4000):
        a, w = rng.normal(0, acceleration / 3**0.5, 3), rng.normal(0, turning / 3**0.5, 3)
        buffer = PoseBuffer(acceleration=acceleration, angular_acceleration=turning)
        shared = rng.normal(0, sigma, 6)
        for t in (-0.02, 0.02):
            buffer.add(
                even_motion(
                    START_NS + round(t * 1e9) + half,
                    position=a * t**2 / 2 + shared[:3],
                    quaternion_xyzw=Rotation.from_rotvec(w * t**2 / 2 + shared[3:]).as_quat(),
                    covariance=np.eye(6) * sigma**2,
                )
            )
        pose = buffer.at(START_NS + half)
        errors.append([*pose.position, *Rotation.from_quat(pose.quaternion_xyzw).as_rotvec()])
    np.testing.assert_allclose(np.var(errors, axis=0), np.diag(pose.covariance), rtol=5 * np.sqrt(2 / 4000))


def test_poses_of_two_frames_are_never_mixed():
    buffer = filled()
    assert buffer.add(even_motion(START_NS + 40 * PERIOD_NS, frame_id="tibia")) is None
    assert len(buffer) == 1
    assert buffer.at(START_NS + 40 * PERIOD_NS).frame_id == "tibia"
    assert buffer.at(START_NS + 39 * PERIOD_NS + 1) is PoseRefusal.TOO_OLD


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"position": np.array([0.0, np.nan, 0.0])}, PoseRefusal.NOT_FINITE),
        ({"covariance": np.full((6, 6), np.inf)}, PoseRefusal.NOT_FINITE),
        ({"quaternion_xyzw": np.array([0.0, 0.0, 0.0, 2.0])}, PoseRefusal.NOT_UNIT),
        ({"quaternion_xyzw": np.zeros(4)}, PoseRefusal.NOT_UNIT),
    ],
)
def test_malformed_poses_are_refused_and_change_nothing(changes, refusal):
    buffer = filled(3)
    assert buffer.add(even_motion(START_NS + 3 * PERIOD_NS, **changes)) is refusal
    assert len(buffer) == 3
    assert buffer.newest_stamp_ns == START_NS + 2 * PERIOD_NS


@pytest.mark.parametrize("settings", [{"max_pose_age": 0.0}, {"capacity": 1}, {"acceleration": -1.0}])
def test_settings_outside_their_range_are_refused(settings):
    with pytest.raises(BadInputError):
        PoseBuffer(**settings)
