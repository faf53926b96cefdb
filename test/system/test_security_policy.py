"""The SROS2 policy allows each node what it does: its topics and services, as the running nodes have them."""

from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy")

from live import Client
from rclpy.node import Node

from knee_gap_bringup.launching.plan import NODES
from knee_gap_bringup.launching.processes import Processes, executable

DOMAIN = 59
POLICY = Path(__file__).parents[2] / "src/knee_gap_bringup/config/sros2_policy.xml"
STARTED = {**NODES, "leg_controller_node": "knee_gap_bringup"}
# Parameters with which a node has more topics than without.
SETTINGS = {
    "tracking_node": ["body_to_shaft_translation:=[0.0, 0.0, 0.0]", "reference_body:=leg"],
    "uncertainty_node": ["leg_motion:=0.001"],
}

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


def allowed() -> dict[tuple[str, str], set[str]]:
    """Names by node and by what is allowed with them: publish, subscribe, reply, request."""
    names: dict[tuple[str, str], set[str]] = defaultdict(set)
    for enclave in ElementTree.parse(POLICY).getroot().findall("enclaves/enclave"):
        (profile,) = enclave.findall("profiles/profile")
        node = profile.get("node", "")
        assert enclave.get("path") == f"{profile.get('ns')}/{node}"
        for group in profile:
            for what, rule in group.attrib.items():
                assert rule == "ALLOW"
                names[node, what].update(str(item.text) for item in group)
    return names


def used(node: Node, name: str) -> dict[str, set[str]]:
    """Names that a node of the graph uses."""
    looks = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return {what: {topic for topic, _ in look(name, "/knee_gap")} for what, look in looks.items()}


def test_the_policy_allows_what_the_nodes_do(tmp_path: Path) -> None:
    environment = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    policy = allowed()
    assert {node for node, _ in policy} == set(STARTED)
    with Processes(tmp_path, environment) as processes, Client(DOMAIN) as client:
        for name, package in STARTED.items():
            command = [executable(package, name), "--ros-args", "-r", "__ns:=/knee_gap"]
            command += [word for setting in SETTINGS.get(name, []) for word in ("-p", setting)]
            processes.start(name, command)
        processes.wait_ready(list(STARTED), 120.0)
        client.spin_until(lambda: set(STARTED) <= set(client.node.get_node_names()))
        client.spin(2.0)
        for name in STARTED:
            for what, names in used(client.node, name).items():
                assert names <= policy[name, what], (name, what)
                if what in ("publish", "reply"):
                    assert names, (name, what)
