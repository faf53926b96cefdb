"""The pose at an image's stamp, between the tracker's poses and a little beyond."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.pose_interpolation import LensPosePredictor
from knee_gap_core.values.poses import LensPose

PERIOD_NS = 8_333_333
POSITION_ERROR = 2e-5  # [m] an axis


def pose(stamp_ns: int, position: np.ndarray, turn: np.ndarray, frame_id: str = "world") -> LensPose:
    covariance = np.diag([POSITION_ERROR**2] * 3 + [1e-9] * 3)
    return LensPose(stamp_ns, frame_id, position, Rotation.from_rotvec(turn).as_quat(), covariance)


def even_motion(stamp_ns: int) -> tuple[np.ndarray, np.ndarray]:
    time = stamp_ns / 1e9
    return np.array([0.01 * time, 0.2 - 0.02 * time, 0.3]), np.array([0.0, 0.5 * time, 0.0])


def test_even_motion_is_told_between_the_poses_and_beyond_them() -> None:
    predictor = LensPosePredictor()
    for k in range(10):
        predictor.add(pose(k * PERIOD_NS, *even_motion(k * PERIOD_NS)))
    for stamp in (6 * PERIOD_NS, 8 * PERIOD_NS + 3_000_000, 9 * PERIOD_NS, 10 * PERIOD_NS + 2_000_000):
        reported = predictor.at(stamp)
        assert reported is not None
        position, turn = even_motion(stamp)
        np.testing.assert_allclose(reported.position, position, atol=1e-9)
        np.testing.assert_allclose(Rotation.from_quat(reported.quaternion_xyzw).as_rotvec(), turn, atol=1e-7)


def test_covariance_covers_a_hands_errors() -> None:
    rng = np.random.default_rng(3)
    normalised = []
    for run in range(600):
        predictor = LensPosePredictor()
        acceleration = rng.normal(0, 0.5 / np.sqrt(3), 3)
        stamps = [k * PERIOD_NS for k in range(6)]
        ahead = stamps[-1] + (4_000_000 if run % 2 else -3_000_000)
        for stamp in stamps:
            true = 0.5 * acceleration * (stamp / 1e9) ** 2
            predictor.add(pose(stamp, true + rng.normal(0, POSITION_ERROR, 3), np.zeros(3)))
        reported = predictor.at(ahead)
        assert reported is not None
        error = reported.position - 0.5 * acceleration * (ahead / 1e9) ** 2
        normalised.append(error @ np.linalg.solve(reported.covariance[:3, :3], error) / 3)
    assert np.mean(normalised) == pytest.approx(1.0, abs=0.15)


def test_error_grows_beyond_the_last_pose() -> None:
    predictor = LensPosePredictor()
    for k in range(10):
        predictor.add(pose(k * PERIOD_NS, *even_motion(k * PERIOD_NS)))
    errors = [predictor.at(9 * PERIOD_NS + ahead) for ahead in (0, 10_000_000, 20_000_000, 39_000_000)]
    variances = [reported.covariance[0, 0] for reported in errors if reported is not None]
    assert len(variances) == 4
    assert variances == sorted(variances)
    assert variances[-1] > 4 * variances[0]


def test_nothing_is_told_far_from_the_poses() -> None:
    predictor = LensPosePredictor()
    assert predictor.at(0) is None
    predictor.add(pose(0, *even_motion(0)))
    assert predictor.at(0) is None
    predictor.add(pose(PERIOD_NS, *even_motion(PERIOD_NS)))
    assert predictor.at(PERIOD_NS) is not None
    assert predictor.at(PERIOD_NS + 50_000_000) is None
    assert predictor.at(-1) is None


def test_a_gap_another_frame_or_an_earlier_stamp_starts_anew() -> None:
    for next_pose in (
        pose(500_000_000, *even_motion(500_000_000)),
        pose(5 * PERIOD_NS, *even_motion(5 * PERIOD_NS), frame_id="other"),
        pose(PERIOD_NS, *even_motion(PERIOD_NS)),
    ):
        predictor = LensPosePredictor()
        for k in range(5):
            predictor.add(pose(k * PERIOD_NS, *even_motion(k * PERIOD_NS)))
        predictor.add(next_pose)
        assert predictor.at(next_pose.stamp_ns + 1_000_000) is None
