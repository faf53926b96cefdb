"""The joint that moves: what is found, what is not taken for motion, and what the estimator then reports."""

from math import radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.joint_motion.joint_motion import (
    FEWEST_CONTRADICTIONS,
    LARGEST_SHIFT,
    Finding,
    JointMotionTest,
)
from knee_gap_uncertainty.joint_motion.motion_statistics import (
    LARGEST_PRESENT,
    motion_statistics,
    observations,
)
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.studies.joint_motion.simulated_motion import Situation, simulate
from knee_gap_uncertainty.studies.joint_motion.table import follow, main, selected

EXACT = EstimatorParameters(**EXACT_SCOPE)

MS = 1_000_000
FRAME_NS = 16_666_667
POINTS = np.array([[0.001, 0.0, 0.012], [-0.002, 0.003, 0.012]])
TRUE_GAP = float(np.linalg.norm(POINTS[1] - POINTS[0]))
SIGMA = radians(0.07)
BOUND = radians(0.15)
LENS_RMS = 0.0367e-3


def observe(
    estimator: GapEstimator,
    lens: Array,
    jumps: Array,
    rng: np.random.Generator,
    points: Array | None = None,
    noise: float = 0.7,
) -> list[GapEstimate]:
    """Images at 60 Hz from `lens` (N, 3); `jumps` (N, 2, 3) are added to the true unit vectors."""
    estimates = []
    seen_points = np.tile(POINTS, (len(lens), 1, 1)) if points is None else points
    for k, position in enumerate(lens):
        stamp = 10**9 + k * FRAME_NS
        for shift_ns in (-MS, MS):
            covariance = np.diag([LENS_RMS**2 / 3] * 3 + [radians(0.004) ** 2 / 3] * 3)
            tracked = position + noise * LENS_RMS / np.sqrt(3) * rng.standard_normal(3)
            pose = LensPose(stamp + shift_ns, "world", tracked, Rotation.identity().as_quat(), covariance)
            estimates += estimator.add_pose(pose, stamp + shift_ns)
            if shift_ns < 0:
                towards = seen_points[k] - position
                bearings = towards / np.linalg.norm(towards, axis=1, keepdims=True)
                bearings = bearings + jumps[k] + noise * SIGMA * rng.standard_normal((2, 3))
                bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
                outer = bearings[:, :, None] * bearings[:, None, :]
                edges = GapEdges.of_points(stamp, 1, bearings, SIGMA**2 * (np.eye(3) - outer), BOUND)
                estimates += estimator.add_edges(edges.with_rims_at_points(), stamp)
    return estimates


def straight(count: int, speed: float, along: tuple[float, float, float] = (1.0, 0.2, 0.0)) -> Array:
    """Lens positions (N, 3) at `speed` [m/s] and 60 Hz."""
    direction = np.array(along) / np.linalg.norm(along)
    return np.arange(count)[:, None] * (speed / 60.0) * direction


def jump(count: int, images: slice, angle_deg: float, towards_deg: float) -> Array:
    """(N, 2, 3): one edge off by an angle in `images`, in a direction of the image."""
    jumps = np.zeros((count, 2, 3))
    around = radians(towards_deg)
    jumps[images, 1] = np.tan(radians(angle_deg)) * np.array([np.cos(around), np.sin(around), 0.0])
    return jumps


def missed(estimates: list[GapEstimate]) -> list[GapEstimate]:
    """Valid estimates whose bounds do not hold the truth."""
    return [
        e
        for e in estimates
        if e.status is GapStatus.VALID and not e.point_distance_min <= TRUE_GAP <= e.point_distance_max
    ]


@pytest.mark.parametrize("towards_deg", [0.0, 11.3, 90.0, 200.0, 300.0])
@pytest.mark.parametrize("speed", [0.003, 0.01, 0.04])
@pytest.mark.parametrize("length", [5, 200])
def test_edge_that_jumps_is_refused_at_once_and_misses_nothing(
    towards_deg: float, speed: float, length: int
) -> None:
    count, at = 80, 40
    estimates = observe(
        GapEstimator(EXACT),
        straight(count, speed),
        jump(count, slice(at, at + length), 3.0, towards_deg),
        np.random.default_rng(5),
    )
    jumped = estimates[at : at + FEWEST_CONTRADICTIONS]
    assert {e.status for e in jumped[:-1]} == {GapStatus.UNKNOWN}
    assert jumped[-1].status is GapStatus.JOINT_MOVED
    assert all(np.isnan([e.gap, e.gap_min, e.gap_max, e.snr]).all() for e in jumped)
    after = estimates[at + FEWEST_CONTRADICTIONS]
    assert after.status is not GapStatus.VALID
    assert after.baseline == 0.0
    assert not (missed(estimates) if length == 5 else missed(estimates[: at + FEWEST_CONTRADICTIONS]))


@pytest.mark.parametrize("towards_deg", [0.0, 11.3, 90.0, 191.3])
@pytest.mark.parametrize("speed", [0.003, 0.01, 0.04])
@pytest.mark.parametrize("length", [1, 2, 5])
def test_track_that_begins_with_a_bad_edge_publishes_nothing_wrong(
    towards_deg: float, speed: float, length: int
) -> None:
    count = 40
    estimates = observe(
        GapEstimator(EXACT),
        straight(count, speed),
        jump(count, slice(0, length), 3.0, towards_deg),
        np.random.default_rng(6),
    )
    assert not missed(estimates)


def test_single_bad_image_costs_one_image() -> None:
    estimates = observe(
        GapEstimator(EXACT), straight(80, 0.01), jump(80, slice(60, 61), 3.0, 30.0), np.random.default_rng(1)
    )
    assert estimates[60].status is GapStatus.UNKNOWN
    assert {e.status for e in estimates[61:]} == {GapStatus.VALID}
    assert estimates[-1].baseline > 0.01


def test_joint_that_moves_ends_the_track_and_the_next_one_is_right() -> None:
    count, at, moved = 240, 100, np.array([0.0, 0.0008, 0.0])
    points = np.tile(POINTS, (count, 1, 1))
    points[:, 0] += np.clip((np.arange(count) - at) / 20.0, 0.0, 1.0)[:, None] * moved
    lens, none = straight(count, 0.01), np.zeros((count, 2, 3))
    estimates = observe(GapEstimator(EXACT), lens, none, np.random.default_rng(2), points)
    ends = [k for k, e in enumerate(estimates) if e.status is GapStatus.JOINT_MOVED]
    assert ends
    assert at < ends[0] <= at + 20
    new_gap = float(np.linalg.norm(points[-1, 1] - points[-1, 0]))
    last = estimates[-1]
    assert last.status is GapStatus.VALID
    assert last.point_distance_min < new_gap < last.point_distance_max
    assert last.point_distance == pytest.approx(new_gap, abs=0.2e-3)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("travel", ["out", "out and back", "fast", "rest"])
def test_still_joint_does_not_alarm(travel: str, share: float) -> None:
    situation = Situation(travel, radians(0.5), share)
    outcomes = [follow(situation, 200, np.random.default_rng([7, k])) for k in range(4)]
    assert [outcome.delay for outcome in outcomes] == [-1] * 4
    assert sum(outcome.refused for outcome in outcomes) <= 4


def test_constant_offset_however_large_is_no_motion() -> None:
    """A calibration error of three standard deviations, on a scope that turns by 17 degrees as it travels."""
    situation = Situation("out", radians(1.0))
    views, _ = simulate(situation, 120, np.random.default_rng(3))
    assert views.lens_rotations is not None
    offset = radians(3.0) * np.einsum("nij,j->ni", views.lens_rotations, [0.8, -0.6, 0.0])
    bearings = views.bearings + offset[:, None]
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    shifted = Views(
        views.lens_positions,
        bearings,
        views.bearing_covariances,
        views.lens_covariances,
        views.rotation_covariances,
        lens_rotations=views.lens_rotations,
    )
    found = motion_statistics(observations(shifted), fit(shifted))
    assert found.shift < LARGEST_SHIFT
    assert found.present < LARGEST_PRESENT


def test_statistics_do_not_depend_on_the_frame() -> None:
    views, _ = simulate(
        Situation("out", radians(0.5), event="across", size=0.5e-3), 60, np.random.default_rng(4)
    )
    turn, move = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix(), np.array([0.3, -0.2, 0.9])
    assert views.lens_rotations is not None
    elsewhere = Views(
        views.lens_positions @ turn.T + move,
        views.bearings @ turn.T,
        turn @ views.bearing_covariances @ turn.T,
        turn @ views.lens_covariances @ turn.T,
        turn @ views.rotation_covariances @ turn.T,
        lens_rotations=turn @ views.lens_rotations,
        times=views.times,
    )
    here = motion_statistics(observations(views), fit(views))
    there = motion_statistics(observations(elsewhere), fit(elsewhere))
    assert there == pytest.approx(here, rel=1e-3)
    assert here.shift > LARGEST_SHIFT
    assert abs(here.shift_after - 29) <= 1


def test_present_statistic_is_chi_square_of_two_bearings() -> None:
    """Its mean over many tracks: the larger of two chi-squares of 2 degrees has the mean 3."""
    present = []
    for k in range(300):
        views, _ = simulate(Situation(deviation=radians(0.3)), 12, np.random.default_rng([8, k]))
        present.append(motion_statistics(observations(views), fit(views)).present)
    assert np.mean(present) == pytest.approx(3.0, abs=4.0 * 2.24 / np.sqrt(300))


def test_rays_that_pass_each_other_are_told_from_two_views() -> None:
    views, _ = simulate(Situation("fast", radians(0.1)), 60, np.random.default_rng(9))
    pair = selected(views, [0, 10])
    test = JointMotionTest()
    assert test.judge(selected(pair, [0]), None) is Finding.STILL
    assert test.judge(pair, None) is Finding.STILL
    travel = pair.lens_positions[1] - pair.lens_positions[0]
    across = np.cross(travel, pair.bearings[1, 0])
    bearings = pair.bearings.copy()
    bearings[1, 0] += radians(1.5) * across / np.linalg.norm(across)
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    apart = Views(
        pair.lens_positions,
        bearings,
        pair.bearing_covariances,
        pair.lens_covariances,
        pair.rotation_covariances,
        lens_rotations=pair.lens_rotations,
    )
    assert test.judge(apart, None) is Finding.CONTRADICTION


def test_table_is_printed_and_a_wrong_number_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--runs", "1", "--images", "20", "--only", "still"]) == 0
    printed = capsys.readouterr().out
    assert "false alarms" in printed
    assert printed.count("half common") == 14
    assert main(["--runs", "0"]) == 2
    assert capsys.readouterr().err == "joint_motion_table: --runs must be at least 1\n"
