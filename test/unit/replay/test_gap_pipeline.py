"""The pipeline of a bag: the tracked body and the edges of two known points give their known distance."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.node.wiring import Output
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeKind, EdgeState, EdgeStatus, GapEdges, SectionEdges
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.segmentation_core import SegmentationCore
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_core import TrackingCore
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.trackers.scope_feed import ScopeFeed
from knee_gap_replay.pipeline import GapPipeline
from knee_gap_replay.processing import process
from knee_gap_replay.topics import InputTopics
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimation.uncertainty_core import UncertaintyCore
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

EXACT = EstimatorParameters(**EXACT_SCOPE)


TOPICS = InputTopics("/image", "/camera_info", "/body")
POINTS = np.array([[0.002, -0.002, 0.012], [0.001, 0.0021, 0.011]])
GAP = float(np.linalg.norm(POINTS[0] - POINTS[1]))
POSE_PERIOD_NS = 8_333_333
TRACKING = TrackingParameters(body_to_shaft_translation=(0.0, 0.01, 0.2), oblique_angle=0.5)
VALID, TRACKING_LOST, INSUFFICIENT_PARALLAX, OUT_OF_SYNC, JOINT_MOVED = 1, 3, 4, 5, 6


def lens_pose(stamp_ns: int) -> Array:
    """Lens moving 2 mm a second along x, turning slowly."""
    seconds = stamp_ns * 1e-9
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02 * seconds, 0.05 * seconds, 0.1]).as_matrix()
    T[:3, 3] = [0.002 * seconds, 0.0, 0.0001 * seconds]
    return T


class TrueEdges:
    """Stands for the segmentation: it knows where the two points are."""

    def __init__(self) -> None:
        self.camera_seen = False
        self.calibration = None
        self.by_notch = False
        self.size_flaw = self.reason = ""
        self.images: list[Any] = []
        self.pose_stamps: list[int] = []

    def on_camera_info(self, message: Any) -> None:
        self.camera_seen = True

    def on_lens_pose(self, message: Any) -> None:
        self.pose_stamps.append(stamp_ns(message.header))

    def on_image(self, message: Any, now_ns: int) -> None:
        self.images.append(message)

    def ready(self, now_ns: int) -> Iterator[GapEdges]:
        while self.images:
            yield self.look(self.images.pop(0))

    def finish(self) -> Iterator[GapEdges]:
        return self.ready(0)

    def look(self, message: Any) -> GapEdges:
        assert self.camera_seen
        stamp = stamp_ns(message.header)
        T = lens_pose(stamp)
        bearings = (POINTS - T[:3, 3]) @ T[:3, :3]
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        nothing = GapEdges.without_points(stamp, "arthroscope_optical", EdgeStatus.VALID, track_id=1)
        planes = np.eye(3) - bearings[:, :, None] * bearings[:, None, :]
        seen = (EdgeState.SEEN, EdgeState.SEEN)
        section = SectionEdges(seen, bearings, np.full(2, 1e-4), 3e-4, np.zeros((2, 2)))
        return replace(
            nothing,
            bearings=bearings,
            kinds=(EdgeKind.RIM, EdgeKind.RIM),
            covariances=planes * 1e-6,
            angular_error=3e-3,
            section=section,
            sections=(section,),
        )


def pipeline_of(edges: TrueEdges, tracker: ScopeTracker, estimator: GapEstimator) -> GapPipeline:
    """A pipeline of cores over these."""
    return GapPipeline(
        SegmentationCore(cast(EdgeStream, edges), blank),
        TrackingCore(tracker, ScopeFeed(), blank),
        UncertaintyCore(estimator, blank),
        TOPICS,
        "/space",
    )


def stamped(msgtype: str, stamp_ns: int) -> Any:
    message = blank(msgtype)
    set_stamp(message.header, stamp_ns)
    return message


def body(stamp_ns: int) -> Any:
    message = stamped("geometry_msgs/msg/PoseStamped", stamp_ns)
    T = lens_pose(stamp_ns) @ np.linalg.inv(TRACKING.body_to_lens())
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = (float(value) for value in T[:3, 3])
    q.x, q.y, q.z, q.w = (float(value) for value in Rotation.from_matrix(T[:3, :3]).as_quat())
    return message


def leg(stamp_ns: int, moved: float) -> Any:
    message = stamped("geometry_msgs/msg/PoseStamped", stamp_ns)
    message.header.frame_id = "world"
    # At rest as well a tracker's numbers change in their last digits.
    message.pose.position.x, message.pose.orientation.w = moved + 1e-15 * stamp_ns, 1.0
    return message


def run(
    end_ns: int, poses_until_ns: int, leg_at: Callable[[int], float | None] | None = None
) -> list[Output]:
    """Outputs for a scope tracked until a stamp; `leg_at`: where the leg body is, None where it is lost."""
    parameters = EstimatorParameters(**EXACT_SCOPE, leg_motion=0.5e-3 if leg_at else 0.0)
    pipeline = pipeline_of(TrueEdges(), ScopeTracker(TRACKING), GapEstimator(parameters))
    outputs = list(pipeline.feed("/camera_info", stamped("sensor_msgs/msg/CameraInfo", 0), 0))
    for index in range(end_ns // POSE_PERIOD_NS):
        stamp_ns = index * POSE_PERIOD_NS
        if stamp_ns <= poses_until_ns:
            outputs += pipeline.feed("/body", body(stamp_ns), stamp_ns)
        if leg_at is not None and (moved := leg_at(stamp_ns)) is not None:
            outputs += pipeline.feed("/space/leg_body/pose", leg(stamp_ns, moved), stamp_ns)
        if index % 2 == 0:
            image_ns = stamp_ns + 1_000_000
            outputs += pipeline.feed("/image", stamped("sensor_msgs/msg/CompressedImage", image_ns), image_ns)
    return [*outputs, *pipeline.finish()]


def on(outputs: list[Output], topic: str) -> list[Any]:
    return [output.message for output in outputs if output.topic == topic]


def test_the_known_distance_comes_out_once_the_scope_has_moved() -> None:
    outputs = run(3_000_000_000, 3_000_000_000)
    gaps = on(outputs, "/space/gap")
    assert len(gaps) == len(on(outputs, "/space/gap_edges")) == 180
    valid = [gap for gap in gaps if gap.status == VALID]
    assert len(valid) > 90
    assert all(gap.point_distance_min < GAP < gap.point_distance_max for gap in valid)
    assert valid[-1].point_distance == pytest.approx(GAP, rel=0.02)
    # The two points stand for rims, and an instrument may come along the line across them.
    assert valid[-1].gap == pytest.approx(GAP, rel=0.03)
    assert gaps[1].status == INSUFFICIENT_PARALLAX


@pytest.mark.parametrize("image_clock_s", [0.0, -1_790_000_000.0 + 5_000.0])
def test_images_stamped_since_boot_are_out_of_sync_as_live(tmp_path: Path, image_clock_s: float) -> None:
    """Poses are stamped since 1970, images and camera model by a clock that began at boot."""
    epoch_ns, shift_ns = 1_790_000_000 * 10**9, round(image_clock_s * 1e9)
    with BagWriter(tmp_path / "bag") as bag:
        for topic, msgtype in (
            ("/camera_info", "sensor_msgs/msg/CameraInfo"),
            ("/body", "geometry_msgs/msg/PoseStamped"),
            ("/image", "sensor_msgs/msg/CompressedImage"),
        ):
            bag.add_topic(topic, msgtype, "sensor")
        for index in range(240):
            stamp_ns = epoch_ns + index * POSE_PERIOD_NS
            tracked = body(index * POSE_PERIOD_NS)
            set_stamp(tracked.header, stamp_ns)
            bag.write("/body", tracked, stamp_ns + 3_000_000)
            if index % 2 == 0:
                image_ns = stamp_ns + 1_000_000
                for topic, msgtype in (("/camera_info", "CameraInfo"), ("/image", "CompressedImage")):
                    message = stamped(f"sensor_msgs/msg/{msgtype}", image_ns + shift_ns)
                    bag.write(topic, message, image_ns + 10_000_000)
    pipeline = pipeline_of(TrueEdges(), ScopeTracker(TRACKING), GapEstimator())
    with BagReader(tmp_path / "bag") as reader, BagWriter(tmp_path / "out") as writer:
        process(reader, writer, pipeline)
    with BagReader(tmp_path / "out") as reader:
        statuses = [reader.deserialize(message).status for message in reader.messages(["/space/gap"])]
    assert len(statuses) == 120
    if image_clock_s:
        # The first may come before any pose, as when a node has just been started.
        assert set(statuses[4:]) == {OUT_OF_SYNC}
    else:
        assert OUT_OF_SYNC not in statuses[4:]


def test_plain_numbers_repeat_the_valid_estimates_and_no_others() -> None:
    outputs = run(3_000_000_000, 3_000_000_000)
    valid = [gap for gap in on(outputs, "/space/gap") if gap.status == VALID]
    for topic, name in (("min", "gap_min"), ("max", "gap_max"), ("snr", "snr")):
        assert [m.data for m in on(outputs, f"/space/gap/{topic}")] == [getattr(gap, name) for gap in valid]


def test_a_leg_body_that_moves_ends_the_track_and_one_that_rests_changes_nothing() -> None:
    end_ns, moves_ns = 3_000_000_000, 2_000_000_000
    alone, rests, moves = (
        on(run(end_ns, end_ns, leg_at), "/space/gap")
        for leg_at in (None, lambda _: 0.0, lambda stamp_ns: 2e-3 if stamp_ns >= moves_ns else 0.0)
    )
    assert [gap.gap for gap in rests if gap.status == VALID] == [
        gap.gap for gap in alone if gap.status == VALID
    ]
    first = next(index for index, gap in enumerate(moves) if gap.status == JOINT_MOVED)
    stamps = [stamp_ns(gap.header) for gap in moves]
    assert moves_ns <= stamps[first] < moves_ns + 3 * POSE_PERIOD_NS
    # What was seen before the move is no part of the new track.
    assert moves[first + 1].status == INSUFFICIENT_PARALLAX
    assert moves[first + 1].view_count == 1


def test_a_leg_body_that_is_lost_leaves_no_number() -> None:
    end_ns, lost_ns = 2_500_000_000, 2_000_000_000
    gaps = on(run(end_ns, end_ns, lambda stamp_ns: None if stamp_ns > lost_ns else 0.0), "/space/gap")
    assert gaps[110].status == VALID
    assert {gap.status for gap in gaps[-20:]} == {TRACKING_LOST}


def test_lens_poses_are_those_of_the_body_with_the_lens_on_it() -> None:
    outputs = run(500_000_000, 500_000_000)
    for pose in on(outputs, "/space/scope_pose"):
        stamp = stamp_ns(pose.header)
        p = pose.pose.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], lens_pose(stamp)[:3, 3], atol=1e-12)


def test_when_the_tracker_goes_silent_so_do_valid_estimates() -> None:
    """As live: an image whose next pose does not come within the allowed wait is reported as lost."""
    outputs = run(3_000_000_000, 2_000_000_000)
    gaps = on(outputs, "/space/gap")
    assert len(gaps) == 180
    for gap in gaps:
        stamp = stamp_ns(gap.header)
        if stamp > 2_000_000_000:
            assert gap.status == TRACKING_LOST


def test_every_output_is_announced_with_its_type() -> None:
    pipeline = pipeline_of(TrueEdges(), ScopeTracker(TRACKING), GapEstimator(EXACT))
    outputs = run(2_500_000_000, 2_500_000_000)
    assert {o.topic for o in outputs} == set(pipeline.outputs)
    assert all(o.message.__msgtype__ == pipeline.outputs[o.topic][0] for o in outputs)


class FaultyEdges(TrueEdges):
    """Raises at every tenth image."""

    def __init__(self) -> None:
        super().__init__()
        self.unanswered: Any = None
        self.reasons: list[str] = []

    def look(self, message: Any) -> GapEdges:
        self.unanswered = message
        if message.header.stamp.nanosec // (2 * POSE_PERIOD_NS) % 10 == 3:
            raise IndexError("no such row")
        return super().look(message)

    def recover(self, reason: str) -> list[GapEdges]:
        self.reasons.append(reason)
        stamp = self.unanswered.header.stamp
        return [
            GapEdges.without_points(
                stamp.sec * 10**9 + stamp.nanosec, "arthroscope_optical", EdgeStatus.UNKNOWN
            )
        ]


@pytest.mark.parametrize("faulty", ["segmentation", "estimator", "tracker"])
def test_what_raises_is_refused_and_the_run_goes_on(faulty: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KNEE_GAP_STRICT", "0")
    edges, estimator, tracker = FaultyEdges(), GapEstimator(), ScopeTracker(TRACKING)
    calls = 0

    def every_tenth(function: Any) -> Any:
        def counted(*arguments: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls % 10 == 0:
                raise ArithmeticError(f"call {calls}")
            return function(*arguments)

        return counted

    if faulty == "estimator":
        monkeypatch.setattr(estimator, "add_edges", every_tenth(estimator.add_edges))
    if faulty == "tracker":
        monkeypatch.setattr(tracker, "take", every_tenth(tracker.take))
    source = edges if faulty == "segmentation" else TrueEdges()
    pipeline = pipeline_of(source, tracker, estimator)
    outputs = list(pipeline.feed("/camera_info", stamped("sensor_msgs/msg/CameraInfo", 0), 0))
    for index in range(120):
        stamp_ns = index * POSE_PERIOD_NS
        outputs += pipeline.feed("/body", body(stamp_ns), stamp_ns)
        if index % 2 == 0:
            image_ns = stamp_ns + 1_000_000
            outputs += pipeline.feed("/image", stamped("sensor_msgs/msg/CompressedImage", image_ns), image_ns)
    outputs += pipeline.finish()
    # Every image is answered, refused or not; what the estimator never took in is silence.
    assert len(on(outputs, "/space/gap_edges")) == 60
    assert len(on(outputs, "/space/gap")) >= (54 if faulty == "estimator" else 60)
    (reported,) = (flaw for flaw in pipeline.flaws() if "refused" in flaw)
    kind = "IndexError" if faulty == "segmentation" else "ArithmeticError"
    assert f"refused: {kind} in " in reported
    if faulty == "segmentation":
        assert len(edges.reasons) == 6
        assert len(set(edges.reasons)) == 1
    if faulty == "estimator":
        # A track does not outlast the fault: the lens goes 0.33 mm between two, and 2 mm in all.
        assert max(gap.baseline for gap in on(outputs, "/space/gap") if gap.baseline > 0.0) < 0.5e-3


def test_in_tests_a_fault_is_raised() -> None:
    pipeline = pipeline_of(FaultyEdges(), ScopeTracker(TRACKING), GapEstimator())
    list(pipeline.feed("/camera_info", stamped("sensor_msgs/msg/CameraInfo", 0), 0))
    image = "sensor_msgs/msg/CompressedImage"

    def feed_all() -> None:
        for index in range(20):
            stamp_ns = index * 2 * POSE_PERIOD_NS
            list(pipeline.feed("/image", stamped(image, stamp_ns), stamp_ns))

    with pytest.raises(IndexError, match="no such row"):
        feed_all()
