"""tracking_node on /tf: the tree from the tracker's frame to the lens, as RViz and tf2 receive it."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live import Client
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.values.poses import rigid_transform
from knee_gap_core.values.stamps import set_stamp, stamp_ns

DOMAIN = 56
ENVIRONMENT = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
NODE = ("--ros-args", "-r", "__ns:=/knee_gap", "-p", "body_to_shaft_translation:=[0.0, 0.01, 0.2]")
BEGIN_NS, PERIOD_NS = 10**18, 8_333_333

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


def pose_of(k: int, place: float, rng: np.random.Generator) -> PoseStamped:
    """A body that moves and turns, with the noise of a tracker."""
    message = PoseStamped()
    set_stamp(message.header, BEGIN_NS + k * PERIOD_NS)
    message.header.frame_id = "world"
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = place + 1e-4 * k, *rng.normal(0.0, 1e-6, 2)
    turn = Rotation.from_rotvec([0.2, place, 1e-3 * k]).as_quat()
    orientation.x, orientation.y, orientation.z, orientation.w = (float(value) for value in turn)
    return message


def frames_of(client: Client) -> dict[tuple[str, str, int], np.ndarray]:
    """The transforms received, by parent, child and stamp."""
    return {
        (one.header.frame_id, one.child_frame_id, stamp_ns(one.header)): matrix(
            one.transform.translation, one.transform.rotation
        )
        for message in client.received["/tf"]
        for one in message.transforms
    }


def matrix(p: object, q: object) -> np.ndarray:
    return rigid_transform([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


@pytest.mark.parametrize("leg", ["", "tibia"], ids=["world", "leg"])
def test_the_lens_on_tf_is_that_of_scope_pose(leg: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        node = [executable("knee_gap_perception", "tracking_node"), *NODE]
        processes.start("tracking_node", [*node, *(["-p", f"reference_body:={leg}"] if leg else [])])
        sent = {"scope_body/pose": 0.3, **({"reference_body/pose": -0.1} if leg else {})}
        for topic in sent:
            client.offer(PoseStamped, topic)
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(TFMessage, "/tf")
        processes.wait_ready(["tracking_node"], 60.0)
        client.wait_matched()
        poses = client.received["scope_pose"]
        bodies: dict[int, np.ndarray] = {}
        for k in range(60):
            for topic, place in sent.items():
                message = pose_of(k, place, rng)
                if topic == "scope_body/pose":
                    bodies[stamp_ns(message.header)] = matrix(message.pose.position, message.pose.orientation)
                client.publish(topic, message)
            client.spin(0.008)
        client.spin_until(lambda: len(poses) > 40 and len(client.received["/tf"]) >= len(poses))
        frames = frames_of(client)
        for pose in poses:
            stamp, root = stamp_ns(pose.header), leg or "world"
            T_root_body = frames[root, "scope_body", stamp]
            T_world_root = frames["world", leg, stamp] if leg else np.eye(4)
            np.testing.assert_allclose(T_world_root @ T_root_body, bodies[stamp], atol=1e-9)
            T_root_lens = T_root_body @ frames["scope_body", "arthroscope_optical", stamp]
            lens = matrix(pose.pose.pose.position, pose.pose.pose.orientation)
            np.testing.assert_allclose(T_root_lens, lens, atol=1e-9)
            assert pose.header.frame_id == root


def test_tf_is_left_alone_where_it_is_not_wanted(tmp_path: Path) -> None:
    with Processes(tmp_path, ENVIRONMENT) as processes, Client(DOMAIN) as client:
        node = [executable("knee_gap_perception", "tracking_node"), *NODE]
        processes.start("quiet", [*node, "-p", "publish_tf:=false", "-r", "__node:=quiet"])
        processes.start("loud", [*node, "-r", "__node:=loud"])
        processes.wait_ready(["quiet", "loud"], 60.0)

        def publishers() -> list[str]:
            return [info.node_name for info in client.node.get_publishers_info_by_topic("/tf")]

        # The name of a publisher's node arrives later than the publisher itself.
        client.spin_until(lambda: "loud" in publishers())
        client.spin(0.5)
        assert publishers() == ["loud"]


def test_frames_of_one_name_end_the_start_in_one_line() -> None:
    command = [executable("knee_gap_perception", "tracking_node"), *NODE, "-p", "body_frame_id:=world"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert "need names of their own" in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
