"""leg_controller_node as a process: it opens by a step, asks for a new measurement, and holds on silence."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TwistStamped
from live import Client
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_msgs.msg import GapEstimate

DOMAIN = 54
PERIOD = 1 / 60
GAP_QOS = QoSProfile(depth=64, deadline=Duration(nanoseconds=100_000_000))

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


class Leg:
    """The controller, a gap that the test publishes, and the commands that come of it."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.asked = 0
        client.offer(GapEstimate, "gap", GAP_QOS)
        client.listen(TwistStamped, "leg/command")
        client.node.create_service(Trigger, "restart", self._start_anew)
        self._reset = client.node.create_client(Trigger, "leg_controller_node/reset")
        client.wait_matched()
        client.spin_until(self._reset.service_is_ready)
        # The track that it receives first may have begun before the leg came to rest.
        began = time.monotonic()
        while not self.asked and time.monotonic() < began + 5.0:
            self.publish(0.0045, 0.005)
            client.spin(PERIOD)
        # A new track begins beside the last estimates of the former, which must have been received before.
        for _ in range(3):
            self.publish(0.0045, 0.005, track_id=self.asked)
            client.spin(PERIOD)
        self.publish(0.003, 0.004, status=GapEstimate.STATUS_INSUFFICIENT_PARALLAX)
        self.asked_at_start = self.asked

    def _start_anew(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self.asked += 1
        answer.success = True
        return answer

    @property
    def rates(self) -> list[float]:
        """The rate in each command so far [m/s]."""
        return [command.twist.linear.x for command in self.client.received["leg/command"]]

    def estimate(self, low: float, high: float, **changes: Any) -> GapEstimate:
        """A sound estimate of now, of the track that began after the last request for a new one."""
        estimate = GapEstimate(status=GapEstimate.STATUS_VALID, track_id=1 + self.asked)
        estimate.gap_min, estimate.gap_max, estimate.gap = low, high, (low + high) / 2
        estimate.header.stamp = self.client.node.get_clock().now().to_msg()
        for name, value in changes.items():
            setattr(estimate, name, value)
        return estimate

    def publish(self, gap_min: float, gap_max: float, **changes: Any) -> None:
        """Publish one estimate."""
        self.client.publish("gap", self.estimate(gap_min, gap_max, **changes))

    def moves(self) -> bool:
        """Whether the last command moves the leg."""
        return bool(self.rates) and self.rates[-1] > 0.0

    def hold_for(self, seconds: float, gap_min: float = 0.0035, gap_max: float = 0.0042) -> None:
        """Publish sound estimates for a while; the leg must not move."""
        before = len(self.rates)
        for _ in range(round(seconds / PERIOD)):
            self.publish(gap_min, gap_max)
            self.client.spin(PERIOD)
        assert not any(self.rates[before:])

    def reset(self) -> tuple[bool, str]:
        """Ask for a reset as a person does; return whether it was done, and the words."""
        answer = self._reset.call_async(Trigger.Request())
        self.client.spin_until(answer.done)
        return answer.result().success, answer.result().message


@pytest.fixture
def leg(tmp_path: Path) -> Iterator[Leg]:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(tmp_path, environment) as started:
        command = [executable("knee_gap_bringup", "leg_controller_node")]
        command += ["--ros-args", "-r", "__ns:=/knee_gap", "-p", "opening_step:=0.3", "-p", "settling:=0.2"]
        command += ["-p", "narrowing_time:=0.0"]
        started.start("leg_controller_node", command)
        started.wait_ready(["leg_controller_node"], 60.0)
        with Client(DOMAIN) as client:
            yield Leg(client)
        assert started.end("leg_controller_node") == 0


def test_opens_by_a_step_measures_anew_and_holds_on_silence(leg: Leg) -> None:
    opened, began = 0.0, time.monotonic()
    last = began
    while time.monotonic() < began + 1.2:
        leg.publish(*((0.0035, 0.0042) if leg.asked == leg.asked_at_start else (0.0045, 0.005)))
        leg.client.spin(PERIOD)
        now = time.monotonic()
        opened += (now - last) * leg.moves()
        last = now
    assert leg.asked == leg.asked_at_start + 1
    assert 0.2 < opened < 0.4
    moving = [rate > 0.0 for rate in leg.rates]
    first = moving.index(True)
    assert not any(moving[first + moving[first:].index(False) :])

    leg.publish(0.003, 0.004, track_id=9)
    leg.client.spin_until(leg.moves)
    # One estimate, and then nothing: the silence holds the leg in the middle of its step.
    leg.client.spin_until(lambda: not leg.moves(), timeout=1.0)


def test_commands_are_stamped_when_they_are_made_and_come_without_a_pause(leg: Leg) -> None:
    leg.client.spin(0.5)
    del leg.client.received["leg/command"][:]
    leg.client.spin(1.0)
    commands = leg.client.received["leg/command"]
    assert len(commands) > 25
    stamps = [command.header.stamp.sec + 1e-9 * command.header.stamp.nanosec for command in commands]
    assert stamps == sorted(stamps)
    assert abs(stamps[-1] - time.time()) < 0.5
    assert {command.header.frame_id for command in commands} == {"leg"}


@pytest.mark.parametrize(
    "changes",
    [
        {"status": GapEstimate.STATUS_JOINT_MOVED},
        {"status": GapEstimate.STATUS_TRACKING_LOST, "track_id": 0},
        {"interval": GapEstimate.INTERVAL_PAPER},
        {"gap": float("nan")},
        {"gap_max": 0.013},
        {"track_id": 9},
    ],
    ids=["joint moved", "lost", "paper", "no gap", "limit", "another track"],
)
def test_inside_a_step_what_is_refused_stops_the_leg_at_once(leg: Leg, changes: dict[str, Any]) -> None:
    leg.publish(0.0035, 0.0042)
    leg.client.spin_until(leg.moves)
    leg.client.publish("gap", leg.estimate(0.0035, 0.0042, **{"gap": 0.004, **changes}))
    sent = time.monotonic()
    leg.client.spin_until(lambda: not leg.moves(), timeout=0.25)
    assert time.monotonic() - sent < 0.15


def test_a_second_publisher_holds_the_leg_until_a_person_resets_it(leg: Leg) -> None:
    leg.hold_for(0.1, 0.0045, 0.005)
    second = leg.client.node.create_publisher(GapEstimate, "gap", GAP_QOS)
    leg.client.spin(1.0)
    leg.hold_for(0.5)
    done, words = leg.reset()
    assert not done
    assert "2 nodes publish the gap" in words
    leg.client.node.destroy_publisher(second)
    leg.client.spin(1.0)
    leg.hold_for(0.5)
    done, words = leg.reset()
    assert done
    assert "2 nodes publish the gap" in words
    for _ in range(60):
        leg.publish(0.0035, 0.0042)
        leg.client.spin(PERIOD)
        if leg.moves():
            break
    assert leg.moves()
    assert leg.asked == leg.asked_at_start + 1


def test_two_messages_of_one_stamp_that_differ_hold_the_leg_until_a_reset(leg: Leg) -> None:
    stamp = leg.client.node.get_clock().now().to_msg()
    for gap_max in (0.0047, 0.0048):
        estimate = leg.estimate(0.0045, gap_max)
        estimate.header.stamp = stamp
        leg.client.publish("gap", estimate)
    leg.client.spin(0.3)
    leg.hold_for(0.5)
    assert leg.reset() == (True, "reset after: two messages of one stamp differ")
