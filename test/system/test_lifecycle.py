"""The nodes are managed: active by themselves, or when asked to be, and silent in every other state."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from live import Client

from knee_gap_bringup.launching.plan import NODES
from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import set_stamp
from knee_gap_msgs.msg import GapEdges, GapEstimate

DOMAIN = 55
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
SCOPE = "body_to_shaft_translation:=[0.0, 0.0, 0.2]"

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with Processes(tmp_path, ENVIRONMENT) as started:
        yield started


@pytest.fixture
def client() -> Iterator[Client]:
    with Client(DOMAIN) as connected:
        yield connected


def start(processes: Processes, node: str, *parameters: str) -> None:
    command = [executable(NODES[node], node), "--ros-args", "-r", "__ns:=/knee_gap"]
    processes.start(node, [*command, *(word for one in parameters for word in ("-p", one))])


def call(client: Client, kind: type, name: str, request: object) -> object:
    service = client.node.create_client(kind, name)
    client.spin_until(service.service_is_ready)
    answer = service.call_async(request)
    client.spin_until(answer.done)
    return answer.result()


def change(client: Client, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(call(client, ChangeState, f"{node}/change_state", request).success)


def state(client: Client, node: str) -> int:
    return int(call(client, GetState, f"{node}/get_state", GetState.Request()).current_state.id)


class Tracker:
    """Sends poses of the tracked body."""

    def __init__(self, client: Client) -> None:
        self._client, self._count = client, 0
        self._rng = np.random.default_rng(3)

    def send(self, count: int) -> int:
        """Send poses; return how many poses of the lens came meanwhile."""
        received = self._client.received["scope_pose"]
        before = len(received)
        for _ in range(count):
            self._count += 1
            message = PoseStamped()
            set_stamp(message.header, 10**18 + self._count * 8_333_333)
            message.header.frame_id = "world"
            message.pose.position.x = self._rng.normal(0.0, 1e-5)
            message.pose.orientation.w = 1.0
            self._client.publish("scope_body/pose", message)
            self._client.spin(0.004)
        self._client.spin(0.5)
        return len(received) - before


def test_a_node_that_is_managed_measures_while_it_is_active_alone(
    processes: Processes, client: Client
) -> None:
    node = "tracking_node"
    start(processes, node, SCOPE, "autostart:=false")
    client.offer(PoseStamped, "scope_body/pose")
    client.listen(PoseWithCovarianceStamped, "scope_pose")
    client.listen(DiagnosticArray, "/diagnostics")
    processes.wait_ready([node], 60.0)
    client.wait_matched()
    tracker = Tracker(client)
    assert state(client, node) == State.PRIMARY_STATE_UNCONFIGURED
    assert tracker.send(30) == 0
    assert not change(client, node, Transition.TRANSITION_ACTIVATE)
    assert change(client, node, Transition.TRANSITION_CONFIGURE)
    assert state(client, node) == State.PRIMARY_STATE_INACTIVE
    assert tracker.send(30) == 0
    words = "not active: call change_state to configure and activate this node"
    client.spin_until(lambda: said(client)[-1:] == [words])
    assert change(client, node, Transition.TRANSITION_ACTIVATE)
    assert tracker.send(60) > 40
    client.spin_until(lambda: "poses in the last second" in said(client)[-1])
    assert change(client, node, Transition.TRANSITION_DEACTIVATE)
    assert tracker.send(30) == 0
    assert change(client, node, Transition.TRANSITION_CLEANUP)
    assert state(client, node) == State.PRIMARY_STATE_UNCONFIGURED
    assert change(client, node, Transition.TRANSITION_CONFIGURE)
    assert change(client, node, Transition.TRANSITION_ACTIVATE)
    assert tracker.send(60) > 40
    assert change(client, node, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert tracker.send(30) == 0
    assert state(client, node) == State.PRIMARY_STATE_FINALIZED
    assert processes.end(node) == 0


def said(client: Client) -> list[str]:
    return [status.message for array in client.received["/diagnostics"] for status in array.status]


def test_the_nodes_are_active_by_themselves(processes: Processes, client: Client) -> None:
    for node in NODES:
        start(processes, node, *([SCOPE] if node == "tracking_node" else []))
    processes.wait_ready(list(NODES), 120.0)
    assert {node: state(client, node) for node in NODES} == dict.fromkeys(NODES, State.PRIMARY_STATE_ACTIVE)


def test_a_gap_is_silent_while_its_node_is_not_active(processes: Processes, client: Client) -> None:
    node = "uncertainty_node"
    start(processes, node)
    client.offer(GapEdges, "gap_edges")
    client.listen(GapEstimate, "gap")
    processes.wait_ready([node], 120.0)
    client.wait_matched()
    gap = client.received["gap"]
    client.spin_until(lambda: len(gap) > 10)
    assert change(client, node, Transition.TRANSITION_DEACTIVATE)
    client.spin(0.3)
    before = len(gap)
    client.spin(1.0)
    assert len(gap) == before
    assert change(client, node, Transition.TRANSITION_ACTIVATE)
    client.spin_until(lambda: len(gap) > before + 10)
    assert {one.status for one in gap} <= {GapEstimate.STATUS_UNKNOWN, GapEstimate.STATUS_NO_EDGES}
