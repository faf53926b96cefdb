"""uncertainty_node as a process: what a controller sees when all is well, and when something is lost."""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Client
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_msgs.msg import GapEdges, GapEstimate
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE

DOMAIN = 51
POINTS = np.array([[0.001, 0.0, 0.012], [-0.002, 0.003, 0.012]])
TRUE_GAP = float(np.linalg.norm(POINTS[1] - POINTS[0]))
FRAME = 1 / 60
# The views here are exact, and so is the scope.
EXACT = [part for name in EXACT_SCOPE for part in ("-p", f"{name}:=0.0")]
COMMAND = [
    executable("knee_gap_uncertainty", "uncertainty_node"),
    *("--ros-args", "-r", "__ns:=/knee_gap", *EXACT),
]

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


def edges_message(stamp_ns: int, x: float, status: int = GapEdges.STATUS_VALID) -> GapEdges:
    towards = POINTS - [x, 0.0, 0.0]
    bearings = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    message = GapEdges(status=status, track_id=1, angular_error=math.radians(0.3))
    set_stamp(message.header, stamp_ns)
    for vector, bearing in zip((message.bearing_0, message.bearing_1), bearings, strict=True):
        vector.x, vector.y, vector.z = (float(value) for value in bearing)
    # The edges are at the points.
    message.edge_0, message.edge_1 = message.bearing_0, message.bearing_1
    message.edge_state_0 = message.edge_state_1 = GapEdges.EDGE_SEEN
    message.edge_deviation_0 = message.edge_deviation_1 = math.radians(0.1)
    message.edge_error = math.radians(0.3)
    variance = math.radians(0.1) ** 2
    message.covariance_0 = (variance * (np.eye(3) - np.outer(bearings[0], bearings[0]))).ravel()
    message.covariance_1 = (variance * (np.eye(3) - np.outer(bearings[1], bearings[1]))).ravel()
    return message


def pose_message(stamp_ns: int, x: float) -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "world"
    set_stamp(message.header, stamp_ns)
    message.pose.pose.position.x = x
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = np.diag([1e-12] * 6).ravel()
    return message


def stamp_of(message: GapEstimate) -> int:
    return stamp_ns(message.header)


class Track:
    """Feeds a scope that travels 6 mm in a second, and back: a track that was lost can be measured again."""

    def __init__(self, client: Client, behind: float = 0.0) -> None:
        """`behind` [s]: how far its stamps are behind the clock."""
        self.client = client
        self.frame = 0
        self._behind_ns = round(behind * 1e9)

    def now_ns(self) -> int:
        """Stamp of an image that is exposed now: a busy machine must not make the stamps fall behind."""
        return time.time_ns() - self._behind_ns

    def run(self, frames: int, *, poses: bool = True, edges: bool = True) -> None:
        for _ in range(frames):
            started = time.monotonic()
            x = 0.003 * (1.0 - math.cos(math.pi * self.frame / 60.0))
            stamp = self.now_ns()
            if poses:
                self.client.publish("scope_pose", pose_message(stamp - 1_000_000, x))
                self.client.publish("scope_pose", pose_message(stamp + 1_000_000, x))
            if edges:
                self.client.publish("gap_edges", edges_message(stamp, x))
            self.frame += 1
            self.client.spin(max(0.0, FRAME - (time.monotonic() - started)))

    def run_until(self, condition: Callable[[], bool], seconds: float = 20.0) -> None:
        """Feed until a condition holds: a busy machine may answer the first images too late."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the condition did not come to hold in time"
            self.run(1)


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(tmp_path, environment) as started:
        started.start("uncertainty_node", COMMAND)
        started.wait_ready(["uncertainty_node"], 120.0)
        yield started


@pytest.fixture
def client(processes: Processes) -> Iterator[Client]:
    with Client(DOMAIN) as connected:
        connected.offer(GapEdges, "gap_edges")
        connected.offer(PoseWithCovarianceStamped, "scope_pose")
        connected.listen(GapEstimate, "gap")
        for name in ("gap/min", "gap/max", "gap/snr"):
            connected.listen(Float64, name)
        connected.wait_matched()
        yield connected


def test_measures_and_tells_every_loss(client: Client) -> None:
    gap = client.received["gap"]
    track = Track(client)

    def valid() -> list[GapEstimate]:
        return [e for e in gap if e.status == GapEstimate.STATUS_VALID]

    track.run_until(lambda: len(valid()) > 40)
    # Every image is answered.
    client.spin_until(lambda: len([e for e in gap if e.track_id]) == track.frame)
    good = valid()
    last = good[-1]
    # The distance of the points is exact; the gap allows for edges that lie behind the points.
    assert last.point_distance == pytest.approx(TRUE_GAP, abs=1e-6)
    assert last.gap_min < TRUE_GAP < last.gap_max
    assert [last.point_0.x, last.point_0.y, last.point_0.z] == pytest.approx(POINTS[0], abs=1e-6)
    assert len(client.received["gap/min"]) == len(good)

    # The tracker goes: the first image without a pose already reports it, and carries no number.
    before, numbers = len(gap), len(client.received["gap/min"])
    track.run(6, edges=True, poses=False)
    client.spin_until(lambda: len([e for e in gap[before:] if e.track_id]) >= 6)
    lost = [e for e in gap[before:] if e.track_id][:6]
    assert {e.status for e in lost} == {GapEstimate.STATUS_TRACKING_LOST}
    assert all(math.isnan(value) for e in lost for value in (e.gap, e.gap_min, e.gap_max, e.snr))
    assert len(client.received["gap/min"]) == numbers

    # It comes back: so do the numbers.
    before = len(gap)
    track.run_until(lambda: any(e.status == GapEstimate.STATUS_VALID for e in gap[before:]))

    # The images go: reported within the deadline, again and again, without a number.
    before = len(gap)
    client.spin(0.5)
    silence = gap[before + 1 :]
    assert len(silence) >= 4
    assert {e.status for e in silence} == {GapEstimate.STATUS_NO_EDGES}
    assert all(math.isnan(e.gap) for e in silence)


def test_says_that_nothing_came_yet_from_its_start(client: Client) -> None:
    gap = client.received["gap"]
    client.spin(0.5)
    assert len(gap) >= 4
    assert {e.status for e in gap} == {GapEstimate.STATUS_UNKNOWN}


@pytest.mark.parametrize("behind", [3600.0, -3600.0])
def test_stamps_an_hour_from_the_clock_are_out_of_sync(client: Client, behind: float) -> None:
    gap = client.received["gap"]
    Track(client, behind).run(70)
    client.spin(0.2)
    answers = [e for e in gap if e.track_id]
    assert len(answers) > 60
    assert {e.status for e in answers} == {GapEstimate.STATUS_OUT_OF_SYNC}


def test_node_that_was_stopped_gives_no_old_number(client: Client, processes: Processes) -> None:
    gap = client.received["gap"]
    track = Track(client)
    track.run_until(lambda: any(e.status == GapEstimate.STATUS_VALID for e in gap))
    os.kill(processes.pid("uncertainty_node"), signal.SIGSTOP)
    track.run(120)
    before, now = len(gap), time.time_ns()
    os.kill(processes.pid("uncertainty_node"), signal.SIGCONT)

    def old() -> list[GapEstimate]:
        return [e for e in gap[before:] if e.track_id and now - stamp_of(e) > 1.0e9]

    client.spin_until(lambda: bool(old()))
    client.spin(0.3)
    backlog = old()
    assert GapEstimate.STATUS_VALID not in {e.status for e in backlog}
    # What comes then is fresh, and measured.
    before = len(gap)
    track.run_until(lambda: any(e.status == GapEstimate.STATUS_VALID for e in gap[before:]))


def test_silence_is_said_when_the_clock_stops_with_the_images(tmp_path: Path) -> None:
    """By a bag's clock no time passes then; the last word must not stay VALID."""
    environment = {"ROS_DOMAIN_ID": str(DOMAIN + 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(tmp_path, environment) as started, Client(DOMAIN + 100) as client:
        started.start("uncertainty_node", [*COMMAND, "-p", "use_sim_time:=true"])
        started.wait_ready(["uncertainty_node"], 120.0)
        client.offer(Clock, "/clock")
        client.offer(GapEdges, "gap_edges")
        client.offer(PoseWithCovarianceStamped, "scope_pose")
        client.listen(GapEstimate, "gap")
        client.wait_matched()
        gap, track = client.received["gap"], Track(client, behind=1e8)
        for _ in range(70):
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(track.now_ns(), 10**9)
            client.publish("/clock", clock)
            track.run(1)
        client.spin_until(lambda: any(e.status == GapEstimate.STATUS_VALID for e in gap))
        before = len(gap)
        client.spin_until(
            lambda: len([e for e in gap[before:] if e.status == GapEstimate.STATUS_NO_EDGES]) >= 4
        )
        assert gap[-1].status != GapEstimate.STATUS_VALID


def test_rubbish_is_survived(client: Client, processes: Processes) -> None:
    track = Track(client)
    track.run(30)
    gap = client.received["gap"]
    stamp = track.now_ns()
    broken = edges_message(stamp, 0.003)
    broken.bearing_0.x = math.nan
    client.publish("gap_edges", broken)
    far = pose_message(stamp, math.inf)
    client.publish("scope_pose", far)
    turned = pose_message(stamp + 1_000_000, 0.003)
    turned.pose.pose.orientation.w = 2.0
    client.publish("scope_pose", turned)
    client.publish("gap_edges", edges_message(0, 0.0))
    client.spin(0.3)
    processes.check("uncertainty_node")
    assert all(e.status != GapEstimate.STATUS_VALID for e in gap[-3:])
    # Time that ran backwards begins a new track, which measures as the first did.
    again = Track(client, behind=5.0)
    before = len(gap)
    again.run_until(lambda: any(e.status == GapEstimate.STATUS_VALID for e in gap[before:]))


def test_dead_node_is_seen_by_its_deadline(client: Client, processes: Processes) -> None:
    missed: list[object] = []
    client.node.create_subscription(
        GapEstimate,
        "gap",
        lambda _message: None,
        QoSProfile(
            depth=1, reliability=ReliabilityPolicy.RELIABLE, deadline=Duration(nanoseconds=200_000_000)
        ),
        event_callbacks=SubscriptionEventCallbacks(deadline=missed.append),
    )
    client.spin(0.5)
    Track(client).run(20)
    missed.clear()
    os.kill(processes.pid("uncertainty_node"), signal.SIGKILL)
    client.spin_until(lambda: bool(missed), timeout=5.0)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_ends_cleanly_when_told(processes: Processes, stop: signal.Signals) -> None:
    os.kill(processes.pid("uncertainty_node"), stop)
    assert processes.wait("uncertainty_node") == 0
    assert "Traceback" not in processes.log("uncertainty_node").read_text()
