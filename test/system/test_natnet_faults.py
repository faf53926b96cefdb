"""tracking_node on a Motive that errs: false poses are not published, and diagnostics give the reason."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Client
from ports import free_port

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_simulation.natnet.scene import TrackedScene

DOMAIN = 64
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
NODE = ("--ros-args", "-r", "__ns:=/knee_gap", "-p", "body_to_shaft_translation:=[0.0, 0.0, 0.0]")
RATE = 120
# Twelve times the noise of the simulated tracker; the faults are tens of millimetres.
CLOSE = 0.4e-3

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


def distance_from_truth(message: PoseWithCovarianceStamped) -> float:
    """How far a published pose is from where the simulated scope was at its stamp [m]."""
    time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    # Motive's Y up, the node's Z up.
    x, y, z = TrackedScene(("scope", "tibia")).true_pose(1, time)[0]
    place = message.pose.pose.position
    return float(np.linalg.norm([place.x - x, place.y + z, place.z - y]))


class Judged:
    """tracking_node, a server with faults, and what is published meanwhile."""

    def __init__(self, processes: Processes, client: Client, *server: str) -> None:
        port = str(free_port())
        command = [executable("knee_gap_simulation", "natnet_server"), "--command-port", port]
        command += ["--rate", str(RATE), "--body", "scope", "--body", "tibia", *server]
        processes.start("server", command)
        node = [executable("knee_gap_perception", "tracking_node"), *NODE]
        parameters = {"source": "natnet", "body": "scope", "command_port": port, "jump_hold": "3.0"}
        for name, value in parameters.items():
            node += ["-p", f"{name}:={value}"]
        processes.start("tracking_node", node)
        self._client = client
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["tracking_node"], 60.0)

    @property
    def poses(self) -> list[PoseWithCovarianceStamped]:
        """What was published."""
        return self._client.received["scope_pose"]

    def words(self) -> list[str]:
        """Messages of the node's diagnostics, one a second."""
        return [status.message for array in self._client.received["/diagnostics"] for status in array.status]

    def refused(self, reason: str) -> int:
        """How many poses were refused for a reason, as last reported."""
        reported = [status for array in self._client.received["/diagnostics"] for status in array.status]
        return int({pair.key: pair.value for pair in reported[-1].values}.get(f"refused: {reason}", 0))


@pytest.mark.parametrize(
    ("fault", "reason", "words"),
    [
        (["--freeze-every", "3.3", "--freeze-for", "0.8"], "frozen", ["the driver is frozen"]),
        (["--swap-every", "3.3", "--swap-for", "0.8"], "swapped", ["gives the body's label to 'tibia'"]),
        (["--jump-every", "3.3", "--jump-for", "0.8"], "jump", ["a jump", "has not come back"]),
        (["--occlude-every", "3.3", "--occlude-for", "0.8"], "not_tracked", ["does not see the body"]),
    ],
    ids=["frozen", "swapped", "jump", "occluded"],
)
def test_what_is_no_measurement_is_not_published(
    fault: list[str], reason: str, words: list[str], tmp_path: Path
) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        judged = Judged(processes, client, *fault)

        def reported() -> bool:
            return any("rejected:" in one and any(word in one for word in words) for one in judged.words())

        def walked() -> bool:
            return len(judged.poses) > 4 * RATE and reported() and judged.refused(reason) > RATE

        # Diagnostics come once a second: not every fault of 0.8 s is in one of them.
        client.spin_until(walked, timeout=60.0)
        assert max(distance_from_truth(pose) for pose in judged.poses) < CLOSE
        assert processes.end("tracking_node") == 0


def test_a_version_that_is_not_read_is_named_with_what_is(tmp_path: Path) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        judged = Judged(processes, client, "--claim-version", "5.0")
        client.spin_until(lambda: any("NatNet 5.0" in one for one in judged.words()), timeout=40.0)
        client.spin_until(
            lambda: any("uses NatNet 5.0; 2.x to 4.x are supported" in one for one in judged.words()),
            timeout=40.0,
        )
        assert not judged.poses
        assert processes.end("tracking_node") == 0


def test_frames_of_another_version_than_the_server_says_give_no_pose(tmp_path: Path) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        judged = Judged(processes, client, "--version", "3.0", "--claim-version", "4.1")
        client.spin_until(lambda: any("cannot be read" in one for one in judged.words()), timeout=40.0)
        assert not judged.poses
        assert processes.end("tracking_node") == 0
