"""leg_controller_node as a process: it opens by a step, asks for a new measurement, and holds on silence."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from live import Client
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from knee_gap_bringup.processes import Processes, executable
from knee_gap_msgs.msg import GapEstimate

DOMAIN = 54
PERIOD = 1 / 60

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(tmp_path, environment) as started:
        command = [
            executable("knee_gap_bringup", "leg_controller_node"),
            "--ros-args",
            "-r",
            "__ns:=/knee_gap",
        ]
        started.start("leg_controller_node", [*command, "-p", "opening_step:=0.3", "-p", "settling:=0.2"])
        started.wait_ready(["leg_controller_node"], 60.0)
        with Client(DOMAIN) as connected:
            deadline = Duration(nanoseconds=100_000_000)
            connected.offer(GapEstimate, "gap", QoSProfile(depth=64, deadline=deadline))
            connected.listen(Float64, "leg/opening_rate")
            connected.wait_matched()
            yield connected


def test_opens_by_a_step_measures_anew_and_holds_on_silence(client: Client) -> None:
    asked: list[Trigger.Request] = []

    def start_anew(request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        asked.append(request)
        answer.success = True
        return answer

    client.node.create_service(Trigger, "start_anew", start_anew)
    client.spin(0.5)
    rates: list[Any] = client.received["leg/opening_rate"]
    for _ in range(60):
        estimate = GapEstimate(status=GapEstimate.STATUS_VALID, track_id=1 + len(asked))
        estimate.gap_min, estimate.gap_max = (0.0035, 0.0042) if not asked else (0.0045, 0.005)
        estimate.header.stamp = client.node.get_clock().now().to_msg()
        client.publish("gap", estimate)
        client.spin(PERIOD)
    opening = [message.data > 0.0 for message in rates]
    assert len(asked) == 1
    assert opening[0]
    assert 10 < sum(opening) < 25
    assert not any(opening[opening.index(False) :])

    estimate = GapEstimate(status=GapEstimate.STATUS_VALID, track_id=3, gap_min=0.003, gap_max=0.004)
    estimate.header.stamp = client.node.get_clock().now().to_msg()
    before = len(rates)
    client.publish("gap", estimate)
    client.spin_until(lambda: len(rates) > before and rates[-1].data > 0.0)
    # One estimate, and then nothing: the deadline holds the leg in the middle of its step.
    client.spin_until(lambda: rates[-1].data == 0.0, timeout=1.0)
