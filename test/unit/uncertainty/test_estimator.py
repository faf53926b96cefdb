"""The estimator: its estimates from given views, and its reasons when something is missing."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tilted_scope import EXACT, FRAME_NS, MS, POINTS, TILT, TRAVEL, TRUE_GAP, edges, pose, run

from knee_gap_core.values.errors import MeasurementError
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.inputs.pose_buffer import PoseRefusal
from knee_gap_uncertainty.two_view.gap_range import gap_range


def test_one_estimate_an_image_and_exact_for_exact_views() -> None:
    positions = list(np.linspace(0.0, 0.006, 60))
    estimates = run(GapEstimator(EXACT), positions)
    assert [e.stamp_ns for e in estimates] == [10**9 + k * FRAME_NS for k in range(60)]
    last = estimates[-1]
    assert last.status is GapStatus.VALID
    assert last.point_distance == pytest.approx(TRUE_GAP, abs=1e-7)
    assert last.point_distance_min < TRUE_GAP < last.point_distance_max
    assert last.baseline == pytest.approx(0.006)
    assert last.points == pytest.approx(POINTS, abs=1e-7)
    assert 20 <= last.view_count <= 60  # views that are too close to others are not kept


def test_the_interval_is_wider_by_what_lasts_over_a_track_and_by_the_drift() -> None:
    positions = list(np.linspace(0.0, 0.006, 120))
    widths = []
    for drift, share in ((0.0, 0.0), (0.002, 0.0), (0.002, 1.0)):
        parameters = replace(EXACT, tracker_scale=0.0, scale_drift=drift, correlated_error_share=share)
        last = run(GapEstimator(parameters), positions)[-1]
        assert last.status is GapStatus.VALID
        widths.append(last.point_distance_confidence_max - last.point_distance_confidence_min)
    assert widths[0] < 0.99 * widths[1] < 0.98 * widths[2]
    default = run(GapEstimator(replace(EXACT, tracker_scale=0.0)), positions)[-1]
    assert default.point_distance_confidence_max - default.point_distance_confidence_min == pytest.approx(
        widths[2]
    )


def test_bounds_are_those_of_the_first_and_the_present_view() -> None:
    parameters = replace(
        EXACT, tracker_drift=0.0, tracker_angular_drift=0.0, unproven_drift=0.0, tracker_scale=0.0
    )
    estimate = run(GapEstimator(parameters), list(np.linspace(0.0, 0.005, 11)))[-1]
    first, now = edges(0, 0.0), edges(0, 0.005)
    expected = gap_range(
        [0, 0, 0],
        [0.005, 0, 0],
        TILT.apply(first.bearings),
        TILT.apply(now.bearings),
        angular_error=np.radians(0.3) + 3.0 * math.sqrt(3e-12),
        translation_error=3.0 * math.sqrt(3e-12),
        apex="best",
    )
    # The interpolated pose carries the bend of the path between its neighbours, about 1e-9 m here.
    assert (estimate.point_distance_min, estimate.point_distance_max) == pytest.approx(
        (expected.gap_min, expected.gap_max), abs=1e-6
    )


def test_without_travel_nothing_is_valid_and_no_gap_is_told() -> None:
    for estimate in run(GapEstimator(EXACT), [1e-12 * k for k in range(30)]):
        assert estimate.status is GapStatus.INSUFFICIENT_PARALLAX
        assert math.isnan(estimate.gap)


def test_poses_too_far_from_the_image_are_out_of_sync() -> None:
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE, max_pose_age=0.02))
    estimator.add_pose(pose(10**9 - 30 * MS, 0.0), 10**9)
    estimator.add_edges(edges(10**9, 0.0), 10**9)
    (estimate,) = estimator.add_pose(pose(10**9 + 30 * MS, 0.0), 10**9 + 10 * MS)
    assert estimate.status is GapStatus.OUT_OF_SYNC


def test_unusable_edges_and_silence_are_no_edges() -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, list(np.linspace(0.0, 0.006, 30)))
    stamp = 10**9 + 30 * FRAME_NS
    (estimate,) = estimator.add_edges(edges(stamp, 0.006, usable=False), stamp)
    assert estimate.status is GapStatus.NO_EDGES
    assert estimator.advance(stamp + 40 * MS) == []
    (silence,) = estimator.advance(stamp + 60 * MS)
    assert silence.status is GapStatus.NO_EDGES
    assert silence.stamp_ns == stamp + 60 * MS
    assert math.isnan(silence.gap)


def test_another_track_starts_from_its_own_first_view() -> None:
    estimator = GapEstimator(EXACT)
    assert run(estimator, TRAVEL)[-1].status is GapStatus.VALID
    estimates = run(estimator, [0.006, 0.006], track_id=2, begin=2 * 10**9)
    assert {e.status for e in estimates} == {GapStatus.INSUFFICIENT_PARALLAX}
    assert {e.baseline for e in estimates} == {0.0}


@pytest.mark.parametrize("topic", ["gap_edges", "scope_pose"])
def test_what_does_not_continue_ends_the_track_and_is_not_measured_with(topic: str) -> None:
    estimator = GapEstimator(EXACT)
    assert run(estimator, TRAVEL)[-1].status is GapStatus.VALID
    estimator.break_input(topic)
    begin = 10**9 + len(TRAVEL) * FRAME_NS
    after = run(estimator, [TRAVEL[-1]] * 3, begin=begin)
    assert [one.status for one in after] == [GapStatus.INSUFFICIENT_PARALLAX] * 3
    assert estimator.counts[f"messages of {topic} that do not continue those before"] == 1
    again = run(estimator, list(np.add(TRAVEL, TRAVEL[-1])), begin=begin + 3 * FRAME_NS)
    assert again[-1].status is GapStatus.VALID


def test_poses_of_two_publishers_in_turn_make_nothing_valid() -> None:
    estimator, statuses = GapEstimator(EXACT), []
    for k, x in enumerate(np.linspace(0.0, 0.006, 60)):
        stamp = 10**9 + k * FRAME_NS
        estimator.break_input("scope_pose")
        statuses += estimator.add_pose(pose(stamp - 2 * MS, x + 0.005), stamp)
        estimator.break_input("scope_pose")
        statuses += estimator.add_pose(pose(stamp - MS, x), stamp)
        statuses += estimator.add_edges(edges(stamp, x), stamp + MS)
        statuses += estimator.add_pose(pose(stamp + MS, x), stamp + 2 * MS)
    assert len(statuses) == 60
    assert GapStatus.VALID not in {one.status for one in statuses}


def test_bag_that_starts_again_keeps_nothing_of_before() -> None:
    estimator = GapEstimator(EXACT)
    before = run(estimator, TRAVEL)
    again = run(estimator, TRAVEL)
    assert [e.status for e in again] == [e.status for e in before]
    assert [e.gap for e in again] == pytest.approx([e.gap for e in before], nan_ok=True)
    assert estimator.counts["stamps ran backwards"] == 1


def test_other_reference_frame_ends_the_track() -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, TRAVEL)
    stamp = 10**9 + len(TRAVEL) * FRAME_NS
    estimator.add_pose(pose(stamp - MS, 0.006, "tibia"), stamp)
    estimator.add_edges(edges(stamp, 0.006), stamp)
    (estimate,) = estimator.add_pose(pose(stamp + MS, 0.006, "tibia"), stamp)
    assert estimate.status is GapStatus.INSUFFICIENT_PARALLAX
    assert estimate.frame_id == "tibia"


@pytest.mark.parametrize("bad", [np.nan, np.inf, 2.0, 0.0])
def test_rubbish_bearings_are_told_and_survived(bad: float) -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, TRAVEL)
    stamp = 10**9 + len(TRAVEL) * FRAME_NS
    broken = edges(stamp, 0.006)
    broken = replace(broken, bearings=broken.bearings * bad)
    estimator.add_pose(pose(stamp - MS, 0.006), stamp)
    (estimate,) = estimator.add_edges(broken, stamp)
    assert estimate.status is not GapStatus.VALID
    assert math.isnan(estimate.gap)
    after = run(estimator, [0.006], begin=stamp + FRAME_NS)
    assert after[-1].status is GapStatus.VALID


def test_pose_that_is_repeated_under_new_stamps_is_lost_tracking() -> None:
    """No old pose is taken for a new one while the scope moves on, from any sender."""
    estimator = GapEstimator(EXACT)
    assert run(estimator, list(np.linspace(0.0, 0.006, 30)))[-1].status is GapStatus.VALID
    begin = 10**9 + 30 * FRAME_NS
    frozen = run(estimator, [0.006] * 30, begin=begin) + estimator.advance(begin + 40 * FRAME_NS)
    assert {e.status for e in frozen[6:]} <= {GapStatus.TRACKING_LOST, GapStatus.NO_EDGES}
    assert estimator.counts[f"pose refused: {PoseRefusal.FROZEN.value}"] >= 40
    moving = run(estimator, [0.006 - 1e-5 * k for k in range(1, 30)], begin=begin + 41 * FRAME_NS)
    assert moving[-1].status is GapStatus.VALID


def test_bound_below_its_own_standard_deviation_is_refused() -> None:
    """The worst case of an error whose bound contradicts its covariance would be none."""
    estimator = GapEstimator(EXACT)
    run(estimator, TRAVEL)
    stamp = 10**9 + len(TRAVEL) * FRAME_NS
    edge = replace(edges(stamp, 0.006), angular_error=np.radians(0.05))
    (estimate,) = estimator.add_edges(edge, stamp)
    assert estimate.status is GapStatus.NO_EDGES
    assert "standard deviation" in estimate.reason


def test_rubbish_poses_are_counted_and_not_used() -> None:
    estimator = GapEstimator(EXACT)
    bad = replace(pose(10**9, 0.0), position=np.array([np.nan, 0.0, 0.0]))
    assert estimator.add_pose(bad, 10**9) == []
    assert sum(n for key, n in estimator.counts.items() if key.startswith("pose refused")) == 1


def test_same_messages_give_same_answers() -> None:
    positions = list(np.linspace(0.0, 0.006, 40))
    first, second = run(GapEstimator(EXACT), positions), run(GapEstimator(EXACT), positions)
    assert [repr(e) for e in first] == [repr(e) for e in second]


@pytest.mark.parametrize(
    ("name", "value"),
    [("interval", "guess"), ("apex", "third"), ("confidence_level", 1.0), ("common_share", -0.1)],
)
def test_settings_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(MeasurementError, match=name):
        EstimatorParameters(**{name: value})  # type: ignore[arg-type]


def leg(stamp_ns: int, moved: float = 0.0, turned: float = 0.0, frame_id: str = "world") -> LensPose:
    """A body 0.2 m beside the lens, with the noise of a tracker in its last digits."""
    jitter = 1e-9 * (stamp_ns % 997)
    return LensPose(
        stamp_ns,
        frame_id,
        np.array([0.2 + moved + jitter, 0.0, 0.0]),
        Rotation.from_euler("z", turned).as_quat(),
        np.zeros((6, 6)),
    )


def run_with_leg(
    estimator: GapEstimator, positions: list[float], leg_at: Callable[[int], LensPose | None]
) -> list[GapEstimate]:
    estimates = []
    for k, x in enumerate(positions):
        if body := leg_at(k):
            estimator.add_leg_pose(body)
        estimates += run(estimator, [x], begin=10**9 + k * FRAME_NS)
    return estimates


def stamp_of(k: int) -> int:
    return 10**9 + k * FRAME_NS


@pytest.mark.parametrize(("moved", "turned"), [(0.6e-3, 0.0), (0.0, 3e-3)])
def test_leg_body_that_moves_ends_the_track(moved: float, turned: float) -> None:
    """3 mrad about a body 0.2 m away are 0.6 mm at the lens, though the body itself stays where it is."""
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE, leg_motion=0.5e-3))
    estimates = run_with_leg(
        estimator,
        list(np.linspace(0.0, 0.006, 40)),
        lambda k: leg(stamp_of(k), moved if k >= 30 else 0.0, turned if k >= 30 else 0.0),
    )
    assert estimates[29].status is GapStatus.VALID
    assert estimates[30].status is GapStatus.JOINT_MOVED
    assert math.isnan(estimates[30].gap)
    assert math.isnan(estimates[30].gap_min)
    assert estimates[31].status is not GapStatus.VALID
    assert estimates[31].baseline < 1e-9
    assert all(e.status is not GapStatus.JOINT_MOVED for e in estimates[31:])


def test_leg_body_at_rest_changes_nothing() -> None:
    positions = list(np.linspace(0.0, 0.006, 40))
    watched = run_with_leg(
        GapEstimator(EstimatorParameters(**EXACT_SCOPE, leg_motion=0.5e-3)),
        positions,
        lambda k: leg(stamp_of(k)),
    )
    unwatched = run(GapEstimator(EXACT), positions)
    assert [repr(e) for e in watched] == [repr(e) for e in unwatched]


def test_leg_body_that_is_lost_or_elsewhere_is_told() -> None:
    """What the track rests on is then not known; nothing is valid."""
    positions = list(np.linspace(0.0, 0.006, 40))
    for leg_at, words in (
        (lambda k: leg(stamp_of(k)) if k < 30 else None, "not tracked any more"),
        (lambda k: None, "no pose of the leg body"),
        (lambda k: leg(stamp_of(k), frame_id="tibia"), "is given in tibia"),
    ):
        last = run_with_leg(
            GapEstimator(EstimatorParameters(**EXACT_SCOPE, leg_motion=0.5e-3)), positions, leg_at
        )[-1]
        assert last.status is GapStatus.TRACKING_LOST
        assert words in last.reason


def test_image_that_comes_long_after_its_poses_gives_no_number() -> None:
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE, max_delay=0.2))
    positions = list(np.linspace(0.0, 0.006, 60))
    run(estimator, positions[:50])
    assert estimator.latest is not None
    assert estimator.latest.status is GapStatus.VALID
    late = []
    for k, x in list(enumerate(positions))[50:]:
        stamp = 10**9 + k * FRAME_NS
        estimator.add_pose(pose(stamp - MS, x), stamp)
        estimator.add_pose(pose(stamp + MS, x), stamp + 2 * MS)
    for k, x in list(enumerate(positions))[50:]:
        stamp = 10**9 + k * FRAME_NS
        late += estimator.add_edges(edges(stamp, x), stamp + 300 * MS)
    assert {e.status for e in late} == {GapStatus.OUT_OF_SYNC}
    assert all(math.isnan(e.gap) for e in late)


def test_backlog_of_poses_and_images_alike_gives_no_number() -> None:
    """Both lay in the node's queue: by their stamps alone neither is later than the other."""
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE, max_delay=0.2))
    positions = list(np.linspace(0.0, 0.006, 60))
    run(estimator, positions[:50])
    late = []
    for k, x in list(enumerate(positions))[50:]:
        stamp, queued = 10**9 + k * FRAME_NS, 300 * MS
        late += estimator.add_pose(pose(stamp - MS, x), stamp + queued, queued)
        late += estimator.add_edges(edges(stamp, x), stamp + queued)
        late += estimator.add_pose(pose(stamp + MS, x), stamp + queued + 2 * MS, queued)
    assert len(late) == 10
    assert {e.status for e in late} == {GapStatus.OUT_OF_SYNC}


def test_pose_without_an_error_is_refused() -> None:
    estimator = GapEstimator(EXACT)
    estimator.add_pose(replace(pose(10**9, 0.0), covariance=np.zeros((6, 6))), 10**9)
    assert estimator.counts[f"pose refused: {PoseRefusal.NO_ERROR.value}"] == 1


def test_gap_beyond_any_joint_is_no_number() -> None:
    estimates = run(
        GapEstimator(EstimatorParameters(**EXACT_SCOPE, largest_gap=0.8 * TRUE_GAP)),
        list(np.linspace(0, 0.006, 60)),
    )
    assert not [e for e in estimates if e.status is GapStatus.VALID]
    assert estimates[-1].status is GapStatus.UNKNOWN


@pytest.mark.parametrize("unseen", [0.5, 3.0])
def test_a_scope_that_comes_back_elsewhere_begins_a_new_track(unseen: float) -> None:
    """A body that slipped by 30 mm while nobody saw it: the views before are of another frame."""
    estimator = GapEstimator(EXACT)
    assert run(estimator, TRAVEL)[-1].status is GapStatus.VALID
    begin = 10**9 + len(TRAVEL) * FRAME_NS + round(unseen * 1e9)
    back = []
    for k in range(20):
        stamp, x = begin + k * FRAME_NS, 0.006 - 1e-4 * k
        estimator.add_pose(pose(stamp - MS, x + 0.03), stamp)
        back += estimator.add_edges(edges(stamp, x), stamp)
        back += estimator.add_pose(pose(stamp + MS, x + 0.03), stamp)
    assert not [
        one for one in back if one.status is GapStatus.VALID and abs(one.point_distance - TRUE_GAP) > 1e-4
    ]
    assert max(one.baseline for one in back if math.isfinite(one.baseline)) < 0.003
    assert sum(n for key, n in estimator.counts.items() if key.startswith("tracks ended")) == 1


def test_a_scope_that_comes_back_where_it_was_goes_on() -> None:
    estimator = GapEstimator(EXACT)
    run(estimator, TRAVEL)
    begin = 10**9 + len(TRAVEL) * FRAME_NS + 500_000_000
    assert run(estimator, [0.006 + 1e-9 * k for k in range(5)], begin=begin)[-1].status is GapStatus.VALID
