"""tracking_node on Motive's own protocol: poses with the time of exposure, and a restart survived."""

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live import Client
from ports import free_port

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import set_stamp

DOMAIN = 53
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
NODE = ("--ros-args", "-r", "__ns:=/knee_gap", "-p", "body_to_shaft_translation:=[0.0, 0.0, 0.0]")

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


def stamp(message: PoseWithCovarianceStamped) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


@pytest.mark.parametrize("version", ["3.0", "4.1"])
def test_poses_come_from_motive_and_come_back_after_a_restart(version: str, tmp_path: Path) -> None:
    port = str(free_port())
    server = [executable("knee_gap_simulation", "natnet_server"), "--version", version, "--rate", "120"]
    server += ["--command-port", port, "--latency-ms", "4"]
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        processes.start("server", server)
        node = [executable("knee_gap_perception", "tracking_node"), *NODE]
        parameters = {"source": "natnet", "body": "scope", "command_port": port}
        for name, value in parameters.items():
            node += ["-p", f"{name}:={value}"]
        processes.start("tracking_node", node)
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["tracking_node"], 60.0)
        poses = client.received["scope_pose"]
        client.spin_until(lambda: len(poses) > 120, timeout=30.0)
        stamps = np.array([stamp(message) for message in poses])
        assert (np.diff(stamps) > 0.0).all()
        assert np.median(np.diff(stamps)) == pytest.approx(1 / 120, abs=5e-4)
        # Exposure lies before arrival, by the latency set in the server and not by much more.
        assert 0.0 < time.time() - stamp(poses[-1]) < 1.0

        processes.end("server")
        client.spin(1.5)
        before = len(poses)
        client.spin(1.0)
        assert len(poses) == before
        reported = [status for array in client.received["/diagnostics"] for status in array.status]
        assert reported[-1].level != b"\x00"
        assert reported[-1].message

        processes.start("server_again", server)
        client.spin_until(lambda: len(poses) > before + 60, timeout=40.0)
        assert processes.end("tracking_node") == 0


def test_leg_as_reference(tmp_path: Path) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        node = [executable("knee_gap_perception", "tracking_node"), *NODE, "-p", "reference_body:=tibia"]
        processes.start("tracking_node", node)
        client.offer(PoseStamped, "scope_body/pose")
        client.offer(PoseStamped, "reference_body/pose")
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        processes.wait_ready(["tracking_node"], 60.0)
        client.wait_matched()
        rng = np.random.default_rng(5)
        for k in range(60):
            # Leg and scope move together: against the leg the scope stands still.
            shift = 1e-4 * k
            for topic, offset in (("reference_body/pose", 0.0), ("scope_body/pose", 0.1)):
                message = PoseStamped()
                set_stamp(message.header, 10**18 + k * 8_333_333)
                message.header.frame_id = "world"
                message.pose.position.x = offset + shift + rng.normal(0.0, 1e-6)
                message.pose.orientation.w = 1.0
                client.publish(topic, message)
            client.spin(0.008)
        poses = client.received["scope_pose"]
        client.spin_until(lambda: len(poses) > 40)
        assert {message.header.frame_id for message in poses} == {"tibia"}
        assert [m.pose.pose.position.x for m in poses] == pytest.approx([0.1] * len(poses), abs=1e-4)


def reported_words(tmp_path: Path, server: list[str], settings: dict[str, str], words: str) -> str:
    """The diagnostics once they hold `words`, with a server and settings of tracking_node."""
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        processes.start("server", [executable("knee_gap_simulation", "natnet_server"), *server])
        node = [executable("knee_gap_perception", "tracking_node"), *NODE, "-p", "source:=natnet"]
        for name, value in settings.items():
            node += ["-p", f"{name}:={value}"]
        processes.start("tracking_node", node)
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["tracking_node"], 60.0)

        def last() -> str:
            reported = [
                status.message for array in client.received["/diagnostics"] for status in array.status
            ]
            return reported[-1] if reported else ""

        client.spin_until(lambda: words in last(), timeout=30.0)
        assert not client.received["scope_pose"]
        assert processes.end("tracking_node") == 0
        return last()


def test_a_body_that_motive_does_not_have_is_told_with_those_it_has(tmp_path: Path) -> None:
    port = str(free_port())
    server = ["--command-port", port, "--body", "probe", "--body", "tibia"]
    reported = reported_words(
        tmp_path, server, {"body": "scope", "command_port": port}, "no rigid body 'scope'"
    )
    assert "'probe' (id 1), 'tibia' (id 2)" in reported


def test_silence_is_told_with_its_likely_causes(tmp_path: Path) -> None:
    settings = {"body": "scope", "command_port": str(free_port())}
    reported = reported_words(
        tmp_path, ["--command-port", str(free_port())], settings, "no answer from 127.0.0.1"
    )
    assert "likely causes: Motive does not run or does not stream" in reported


def test_a_server_that_shows_no_frames_is_told_from_one_that_is_not_there(tmp_path: Path) -> None:
    port = str(free_port())
    server = ["--command-port", port, "--lose", "1.0"]
    reported = reported_words(tmp_path, server, {"body": "scope", "command_port": port}, "but no data for")
    assert reported.startswith("connected to Motive")
    assert "likely causes" in reported


def test_of_two_servers_one_is_listened_to(tmp_path: Path) -> None:
    ports = [str(free_port()), str(free_port())]
    data = str(free_port())
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        for number, (port, name) in enumerate(zip(ports, ("scope", "other"), strict=True)):
            server = [executable("knee_gap_simulation", "natnet_server"), "--command-port", port]
            server += ["--multicast", "239.255.42.99", "--data-port", data, "--body", name]
            processes.start(f"server_{number}", [*server, "--seed", str(number), "--rate", "100"])
        node = [executable("knee_gap_perception", "tracking_node"), *NODE, "-p", "source:=natnet"]
        node += ["-p", "body:=scope", "-p", f"command_port:={ports[0]}", "-p", "local_address:=127.0.0.1"]
        node += ["-p", f"data_port:={data}"]
        processes.start("tracking_node", node)
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["tracking_node"], 60.0)
        poses = client.received["scope_pose"]
        client.spin_until(lambda: len(poses) > 150, timeout=40.0)
        stamps = np.array([stamp(message) for message in poses])
        # Frames of both, one after the other, would run to and fro and be twice as many.
        assert (np.diff(stamps) > 0.0).all()
        assert np.median(np.diff(stamps)) == pytest.approx(1 / 100, abs=2e-3)
