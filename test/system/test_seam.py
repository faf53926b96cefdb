"""Nodes whose callbacks raise: they live, reset their core, and report what was refused."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from live import Client
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from knee_gap_bringup.launching.processes import Processes

DOMAIN = 131
NODE = """
import sys
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from knee_gap_core.live.base_node import RESULT_QOS, BaseNode, run

class RootNode(BaseNode):
    def __init__(self):
        super().__init__("root_node", health=lambda: (True, "well", {}))
        self.answers = self.create_publisher(Float64, "root", RESULT_QOS)
        self.create_subscription(Float64, "square", self.on_square, RESULT_QOS)
        self.create_service(Trigger, "fail", self.on_fail)
        self.create_timer(0.1, self.on_tick)

    def on_square(self, message):
        assert message.data >= 0.0, "no square"
        self.answers.publish(Float64(data=message.data ** 0.5))

    def on_fail(self, request, response):
        raise KeyError("missing")

    def on_tick(self):
        raise RuntimeError("a tick")

    def recover(self, fault):
        self.answers.publish(Float64(data=-1.0))
        if "message" in fault.what:
            raise ValueError("no recovery either")

sys.exit(run(RootNode))
"""

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


class Root:
    def __init__(self, client: Client, processes: Processes) -> None:
        self.client, self.processes = client, processes

    def send(self, value: float) -> float:
        """Publish a square; returns the answer to it, which comes between those of the timer."""
        answers = self.client.received["root"]
        before = len(answers)
        self.client.publish("square", Float64(data=value))
        self.client.spin_until(lambda: any(answer.data != -1.0 for answer in answers[before:]))
        return next(answer.data for answer in answers[before:] if answer.data != -1.0)


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("node") / "root_node.py"
    path.write_text(NODE)
    return path


@pytest.fixture(scope="module")
def root(script: Path) -> Iterator[Root]:
    environment = {
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "KNEE_GAP_STRICT": "0",
    }
    with Processes(script.parent, environment) as processes, Client(DOMAIN) as client:
        command = [sys.executable, str(script), "--ros-args", "-r", "__ns:=/knee_gap", "--log-level", "debug"]
        processes.start("root_node", command)
        client.offer(Float64, "square")
        client.listen(Float64, "root")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["root_node"], 60.0)
        client.wait_matched()
        yield Root(client, processes)
        processes.check("root_node")


def test_a_message_that_raises_is_refused_and_the_next_is_answered(root: Root) -> None:
    assert root.send(9.0) == 3.0
    for _ in range(5):
        root.client.publish("square", Float64(data=-1.0))
    assert root.send(16.0) == 4.0
    root.processes.check("root_node")


def test_a_request_that_raises_is_answered_with_the_reason(root: Root) -> None:
    caller = root.client.node.create_client(Trigger, "fail")
    root.client.spin_until(caller.service_is_ready)
    future = caller.call_async(Trigger.Request())
    root.client.spin_until(future.done)
    assert not future.result().success
    assert "KeyError in root_node.py" in future.result().message
    assert root.send(25.0) == 5.0


def test_what_was_refused_is_counted_and_logged_once_with_its_place(root: Root) -> None:
    diagnostics = root.client.received["/diagnostics"]

    def refused() -> dict[str, int]:
        rows = [row for message in diagnostics[-1:] for row in message.status[0].values]
        return {row.key: int(row.value) for row in rows if "refused" in row.key}

    root.client.spin_until(lambda: any("message on square" in key for key in refused()))
    counts = refused()
    (squares,) = (count for key, count in counts.items() if key.startswith("message on square refused"))
    assert squares == 5
    assert any("call of on_tick refused: RuntimeError in root_node.py" in key for key in counts)
    assert any(key.startswith("recovery after message on square refused: ValueError") for key in counts)
    root.client.spin_until(lambda: diagnostics[-1].status[0].level == DiagnosticStatus.WARN)
    log = root.processes.log("root_node").read_text()
    assert log.count("message on square refused: AssertionError in root_node.py") == 1
    assert log.count("call of on_tick refused") == 1
    # The story is for debugging.
    assert all("[DEBUG]" in line for line in log.splitlines() if "Traceback" in line)


def test_in_tests_a_fault_is_loud(script: Path, tmp_path: Path) -> None:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(tmp_path, environment) as processes:
        processes.start("root_node", [sys.executable, str(script)])
        assert processes.wait("root_node") != 0
    assert "RuntimeError: a tick" in (tmp_path / "root_node.log").read_text()
