"""Whatever comes, the estimator answers every image with an estimate, and never raises."""

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hostile import BEGIN, SETTINGS, header, hurt, numbers, poses, sequences, stamps, steps_ns, vector
from hypothesis import given
from hypothesis import strategies as st

from knee_gap_core.conversions.edge_messages import edges_from_message
from knee_gap_core.conversions.pose_messages import lens_pose_from_message
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation import messages
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.inputs.pose_buffer import PoseBuffer

POINTS = np.array([[2e-3, -2e-3, 12e-3], [1e-3, 2.1e-3, 11e-3]])
BEGIN_NS = BEGIN * 10**9
# A warning of numpy's ends nothing; what is held here is that nothing raises and no bad number is VALID.
pytestmark = pytest.mark.filterwarnings("default::RuntimeWarning")


def edges(draw: Any, stamp_ns: int) -> Any:
    """A GapEdges, most often of the two points as a moving lens sees them."""
    bearings = POINTS - np.array([1e-5, 0.0, 0.0]) * (stamp_ns % 10**9) / 1e7
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    planes = np.eye(3) - bearings[:, :, None] * bearings[:, None, :]
    message = SimpleNamespace(
        header=header(stamp_ns, "arthroscope_optical", draw(st.sampled_from([0] * 9 + [3 * 10**9]))),
        status=draw(st.sampled_from([1] * 8 + [0, 2, 3, 255])),
        track_id=draw(st.sampled_from([1] * 8 + [0, 2, 2**32 - 1])),
        angular_error=float(hurt(draw, [3e-3], share=8)[0]),
        pose_used=True,
    )
    for index in (0, 1):
        setattr(message, f"bearing_{index}", vector(hurt(draw, bearings[index], share=8)))
        setattr(message, f"pixel_{index}", np.array([300.0, 200.0]))
        setattr(message, f"kind_{index}", draw(st.sampled_from([1, 3, 77])))
        setattr(message, f"hidden_{index}", False)
        setattr(message, f"covariance_{index}", hurt(draw, (1e-7 * planes[index]).ravel(), share=8))
        setattr(message, f"camera_error_{index}", hurt(draw, np.full(27, np.nan), share=8))
        setattr(message, f"edge_{index}", vector(hurt(draw, bearings[index], share=8)))
        setattr(message, f"edge_state_{index}", draw(st.sampled_from([1] * 6 + [0, 2, 255])))
        setattr(message, f"edge_pixel_{index}", np.array([300.0, 180.0]))
        setattr(message, f"edge_deviation_{index}", float(hurt(draw, [1e-3], share=8)[0]))
    message.edge_error = float(hurt(draw, [3e-3], share=8)[0])
    message.sections = [
        SimpleNamespace(
            edge_0=vector(hurt(draw, bearings[0], share=8)),
            edge_1=vector(hurt(draw, bearings[1], share=8)),
            edge_error=float(hurt(draw, [3e-3], share=8)[0]),
        )
        for _ in range(draw(st.integers(0, 2)))
    ]
    return message


def calibration(draw: Any) -> Any:
    return SimpleNamespace(
        node=draw(st.sampled_from(["segmentation_node", "tracking_node", ""])),
        hash=draw(st.sampled_from(["", "a", "b"])),
        width_px=640,
        height_px=360,
        lens_covariance=hurt(draw, np.diag([1e-9] * 3 + [1e-7] * 3).ravel(), share=2),
        time_offset=draw(numbers),
        time_offset_error=draw(numbers),
        rotation_followed=draw(st.booleans()),
    )


def take(estimator: GapEstimator, draw: Any, stamp_ns: int, now_ns: int) -> list[Any]:
    """Hand the estimator a message of any kind."""
    kind = draw(st.sampled_from(["pose"] * 5 + ["edges"] * 4 + ["turn", "leg", "calibration", "time"]))
    if kind == "pose":
        pose = lens_pose_from_message(draw(poses(stamp_ns)))
        return estimator.add_pose(pose, now_ns, draw(st.sampled_from([0, 10**7, 10**12])))
    if kind == "edges":
        return estimator.add_edges(edges_from_message(edges(draw, stamp_ns)), now_ns)
    if kind == "turn":
        turn = SimpleNamespace(header=header(stamp_ns), turn=draw(numbers))
        return estimator.add_rotation(messages.rotation_from_message(turn), now_ns)
    if kind == "leg":
        estimator.add_leg_pose(messages.leg_pose_from_message(draw(poses(stamp_ns, covered=False))))
    if kind == "calibration":
        estimator.add_calibration(messages.calibration_from_message(calibration(draw)))
    return estimator.advance(now_ns)


@pytest.fixture(scope="module")
def moved() -> GapEstimator:
    """An estimator that has followed the two points over 4 mm, so that it has a track and a valid gap."""
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE))
    for k in range(30):
        stamp = BEGIN_NS - (31 - k) * 16_666_667
        lens = np.array([4e-3 * k / 30, 0.0, 0.0])
        covariance = np.diag([4.5e-10] * 3 + [1.6e-9] * 3)
        pose = LensPose(stamp, "world", lens, np.array([0.0, 0.0, 0.0, 1.0]), covariance)
        estimator.add_pose(pose, stamp)
        bearings = POINTS - lens
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        planes = np.eye(3) - bearings[:, :, None] * bearings[:, None, :]
        estimator.add_edges(
            GapEdges.of_points(
                stamp_ns=stamp,
                track_id=1,
                bearings=bearings,
                covariances=1e-7 * planes,
                angular_error=3e-3,
            ).with_rims_at_points(),
            stamp,
        )
    assert estimator.counts["VALID"] > 0
    return estimator


@SETTINGS
@given(st.data())
def test_messages_of_every_kind_in_any_order(data: Any) -> None:
    estimator = GapEstimator(EstimatorParameters(leg_motion=data.draw(st.sampled_from([0.0, 5e-4]))))
    for stamp in stamps(data.draw(st.lists(steps_ns, min_size=1, max_size=40))):
        now_ns = stamp + data.draw(st.sampled_from([0, 10**7, 10**9, -(10**9), 10**13]))
        for estimate in take(estimator, data.draw, stamp, now_ns):
            assert estimate.status is GapStatus.VALID or estimate.reason
            if estimate.status is GapStatus.VALID:
                numbers = [estimate.gap_min, estimate.gap, estimate.gap_max, estimate.snr]
                assert np.isfinite(numbers).all()
                assert 0.0 < numbers[0] <= numbers[1] <= numbers[2]


@SETTINGS
@given(st.data())
def test_a_track_that_is_hurt(moved: GapEstimator, data: Any) -> None:
    estimator = copy.deepcopy(moved)
    for stamp in stamps(data.draw(st.lists(steps_ns, min_size=1, max_size=12))):
        take(estimator, data.draw, stamp, stamp)
    count = sum(estimator.counts[status.name] for status in GapStatus)
    estimator.advance(BEGIN_NS + 10**14)
    assert sum(estimator.counts[status.name] for status in GapStatus) >= count


@SETTINGS
@given(sequences(poses, longest=60), st.lists(steps_ns, min_size=5, max_size=5))
def test_the_pose_buffer(given_poses: list[tuple[int, Any]], steps: list[int]) -> None:
    buffer = PoseBuffer()
    for stamp, message in given_poses:
        refusal = buffer.add(lens_pose_from_message(message))
        assert refusal is None or refusal.value
        for step in steps:
            pose = buffer.at(stamp + step)
            if isinstance(pose, LensPose):
                assert abs(np.linalg.norm(pose.quaternion_xyzw) - 1.0) < 1e-2
