"""suite_node: the three nodes in one process measure the gap of the sample, and each can be listened to."""

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Client
from sample_bag import SAMPLE

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_msgs.msg import GapEdges, GapEstimate

DOMAIN = 58
# Played slowly, so that a busy machine keeps up: the stamps then fall behind the clock.
RATE = "0.3"
PATIENT = """
/**/segmentation_node:
  ros__parameters: {max_pose_wait: 0.09}
/**/uncertainty_node:
  ros__parameters: {max_pose_wait: 0.5, max_delay: 10.0}
"""
INPUTS = [f"/knee_gap/{topic}" for topic in ("image_raw/compressed", "camera_info", "scope_body/pose")]

pytestmark = [pytest.mark.system, pytest.mark.timeout(240)]


def test_the_gap_of_the_sample_is_measured_and_every_step_published(tmp_path: Path) -> None:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    suite = [executable("knee_gap_bringup", "suite_node"), "--ros-args", "-r", "__ns:=/knee_gap"]
    play = [executable("knee_gap_replay", "play"), str(SAMPLE), "--rate", RATE]
    parameters = tmp_path / "patient.yaml"
    parameters.write_text(PATIENT)
    with Processes(tmp_path, environment) as processes, Client(DOMAIN) as client:
        files = (str(SAMPLE / "scope.yaml"), str(parameters))
        processes.start("suite_node", [*suite, *(word for file in files for word in ("--params-file", file))])
        processes.wait_ready(["suite_node"], 120.0)
        client.listen(GapEstimate, "gap")
        client.listen(GapEdges, "gap_edges")
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        processes.start("play", [*play, "--topics", *INPUTS, "--wait-for", *INPUTS])
        client.spin_until(
            lambda: any(one.status == GapEstimate.STATUS_VALID for one in client.received["gap"]), 60.0
        )
        names = set(client.node.get_node_names())
        processes.check("suite_node")
        valid = next(one for one in client.received["gap"] if one.status == GapEstimate.STATUS_VALID)
        assert stamp_ns(valid.header) in {stamp_ns(one.header) for one in client.received["gap_edges"]}
        assert len(client.received["scope_pose"]) > 10
        assert {"segmentation_node", "tracking_node", "uncertainty_node"} <= names
        assert processes.end("suite_node") in (0, -signal.SIGINT)
