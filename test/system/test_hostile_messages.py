"""The live nodes under messages as nobody should send them: none ends, and each goes on answering."""

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, TwistStamped
from hostile import SETTINGS, header, hurt, names, numbers, poses, stamps, steps_ns
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from live import RELIABLE, Client
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sample_bag import SAMPLE, sample_camera_info
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_msgs.msg import GapEdges, GapEstimate, ScopeCalibration, ScopeRotation
from knee_gap_simulation.recordings.recording import IMAGE

DOMAIN = 132
# As the suite is shipped, so that the seam itself is tested; the diagnostics show that it had nothing to do.
ENVIRONMENT = {
    "ROS_DOMAIN_ID": str(DOMAIN),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "KNEE_GAP_STRICT": "0",
}
NODES = {
    "segmentation_node": ("knee_gap_perception", ["-p", "image_transport:=compressed"]),
    "tracking_node": ("knee_gap_perception", ["-p", "body_to_shaft_translation:=[0.0, 0.0, 0.0]"]),
    "uncertainty_node": ("knee_gap_uncertainty", ["-p", "leg_motion:=0.001"]),
    "leg_controller_node": ("knee_gap_bringup", []),
}
TOPICS: dict[str, type] = {
    "image_raw/compressed": CompressedImage,
    "camera_info": CameraInfo,
    "clicked_point": PointStamped,
    "scope_body/pose": PoseStamped,
    "scope_pose": PoseWithCovarianceStamped,
    "leg_body/pose": PoseStamped,
    "gap_edges": GapEdges,
    "scope_rotation": ScopeRotation,
    "scope_calibration": ScopeCalibration,
    "gap": GapEstimate,
}
# The last words of a calibration, and a gap that comes often enough for a controller.
QOS = {
    "scope_calibration": QoSProfile(depth=8, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    "gap": QoSProfile(depth=256, deadline=Duration(nanoseconds=50_000_000)),
}
pytestmark = [pytest.mark.system, pytest.mark.timeout(240)]


def filled(message: Any, values: Any) -> Any:
    """A ROS message with the numbers of a namespace in the fields that have them."""
    for name, value in vars(values).items():
        if isinstance(value, SimpleNamespace):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def any_numbers(message: Any, draw: Any) -> Any:
    """A ROS message whose floating-point fields may be anything, and the others in their range."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if kind == "double":
            setattr(message, name, draw(numbers))
        elif kind.startswith("double["):
            setattr(message, name, hurt(draw, np.full(len(value), 1e-9), share=2))
        elif kind == "sequence<double>":
            setattr(message, name, [draw(numbers) for _ in range(draw(st.sampled_from([0, 4, 5, 33])))])
        elif kind in ("uint8", "uint32"):
            setattr(message, name, draw(st.sampled_from([0, 1, 2, 255])))
        elif kind == "string":
            setattr(message, name, draw(names))
        elif hasattr(value, "get_fields_and_field_types") and not isinstance(value, Time | Header):
            any_numbers(value, draw)
    return message


def hostile(topic: str, stamp_ns: int, draw: Any, pictures: list[bytes]) -> Any:
    """A message of a topic, as hostile as one may be."""
    message = TOPICS[topic]()
    if topic == "image_raw/compressed":
        data = draw(st.sampled_from(pictures))
        data = draw(st.sampled_from([data] * 4 + [data[: len(data) // 2], b"", b"\xff\xd8", bytes(200)]))
        message.format = draw(st.sampled_from(["jpeg"] * 4 + ["", "16UC1; compressedDepth"]))
        message.data = data
    elif topic in ("scope_body/pose", "leg_body/pose"):
        return filled(message, draw(poses(stamp_ns, covered=False)))
    elif topic == "scope_pose":
        return filled(message, draw(poses(stamp_ns)))
    else:
        any_numbers(message, draw)
    if hasattr(message, "header"):
        filled(message.header, header(stamp_ns, draw(names), draw(st.sampled_from([0] * 9 + [3 * 10**9]))))
    return message


class Suite:
    """The running nodes, and a client that sends them what they should not get."""

    def __init__(self, client: Client, processes: Processes) -> None:
        self.client, self.processes = client, processes
        with BagReader(SAMPLE) as bag:
            entries = zip(bag.messages([IMAGE]), range(6), strict=False)
            self.pictures = [bytes(bag.deserialize(entry).data) for entry, _ in entries]
        info = sample_camera_info()
        self.info = CameraInfo(width=info.width, height=info.height, distortion_model=info.distortion_model)
        self.info.d, self.info.k = list(info.d), np.array(info.k)
        self.stamp_ns = 2 * 10**18

    def check(self) -> None:
        """Fail if a node has ended."""
        for name in NODES:
            self.processes.check(name)

    def faults(self) -> list[str]:
        """What the nodes' seams refused."""
        messages = self.client.received["/diagnostics"]
        rows = [row for message in messages for status in message.status for row in status.values]
        return sorted({row.key for row in rows if re.search(r" refused: \w+ in \w+\.py:", row.key)})

    def answer(self) -> GapEdges:
        """The edges of a good image with its camera."""
        self.client.publish("camera_info", self.info)
        self.client.spin(0.1)
        self.stamp_ns += 10**9
        message = CompressedImage(format="jpeg", data=self.pictures[0])
        filled(message.header, header(self.stamp_ns, "arthroscope_optical"))
        self.client.publish("image_raw/compressed", message)
        edges = self.client.received["gap_edges"]
        seconds = self.stamp_ns // 10**9
        self.client.spin_until(lambda: any(edge.header.stamp.sec == seconds for edge in edges))
        return next(edge for edge in edges if edge.header.stamp.sec == seconds)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Suite]:
    with Processes(tmp_path_factory.mktemp("logs"), ENVIRONMENT) as processes, Client(DOMAIN) as client:
        for name, (package, options) in NODES.items():
            command = [executable(package, name), "--ros-args", "-r", "__ns:=/knee_gap", *options]
            processes.start(name, command)
        for topic, kind in TOPICS.items():
            client.offer(kind, topic, QOS.get(topic, RELIABLE))
        client.listen(GapEdges, "gap_edges")
        client.listen(GapEstimate, "gap")
        client.listen(PoseWithCovarianceStamped, "scope_pose")
        client.listen(TwistStamped, "leg/command")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(list(NODES), 120.0)
        client.wait_matched()
        yield Suite(client, processes)


def test_no_message_ends_a_node(suite: Suite) -> None:
    @settings(SETTINGS, max_examples=25, phases=[Phase.generate])
    @given(st.data())
    def flood(data: Any) -> None:
        topics = st.sampled_from(sorted(TOPICS))
        for stamp in stamps(data.draw(st.lists(steps_ns, min_size=5, max_size=30))):
            topic = data.draw(topics)
            suite.client.publish(topic, hostile(topic, stamp, data.draw, suite.pictures))
            suite.client.spin(0.002)
        suite.check()

    flood()
    # All of it has been taken when the next good image is answered.
    assert suite.answer().status == GapEdges.STATUS_VALID
    suite.check()
    diagnostics = suite.client.received["/diagnostics"]
    diagnostics.clear()
    suite.client.spin_until(
        lambda: set(NODES) <= {s.name.split("/")[-1] for message in diagnostics for s in message.status}
    )
    assert suite.faults() == []


def test_each_node_answers_afterwards(suite: Suite) -> None:
    suite.client.spin(0.5)
    assert suite.answer().status == GapEdges.STATUS_VALID
    gaps = suite.client.received["gap"]
    seconds = suite.stamp_ns // 10**9
    suite.client.spin_until(lambda: any(gap.header.stamp.sec == seconds for gap in gaps))
    lenses, rates = suite.client.received["scope_pose"], suite.client.received["leg/command"]
    sent, rated = len(lenses), len(rates)
    for k in range(20):
        body = PoseStamped()
        filled(body.header, header(suite.stamp_ns + 10**12 + k * 8_333_333))
        body.pose.position.x, body.pose.orientation.w = 1e-6 * k, 1.0
        suite.client.publish("scope_body/pose", body)
        suite.client.spin(0.01)
    suite.client.spin_until(lambda: len(lenses) > sent)
    suite.client.publish("gap", GapEstimate())
    suite.client.spin_until(lambda: len(rates) > rated)
    suite.check()


def test_a_clock_of_no_time_ends_no_node(tmp_path: Path) -> None:
    environment = {**ENVIRONMENT, "ROS_DOMAIN_ID": str(DOMAIN + 1)}
    with Processes(tmp_path, environment) as processes, Client(DOMAIN + 1) as client:
        package, options = NODES["uncertainty_node"]
        command = [executable(package, "uncertainty_node"), "--ros-args", "-r", "__ns:=/knee_gap"]
        processes.start("uncertainty_node", [*command, *options, "-p", "use_sim_time:=true"])
        client.offer(Clock, "/clock")
        client.listen(DiagnosticArray, "/diagnostics")
        processes.wait_ready(["uncertainty_node"], 60.0)
        client.wait_matched()
        for seconds, nanoseconds in ((5, 0), (-5, 0), (0, 0), (2**31 - 1, 2**32 - 1), (-(2**31), 7), (6, 0)):
            message = Clock()
            message.clock.sec, message.clock.nanosec = seconds, nanoseconds
            client.publish("/clock", message)
            client.spin(0.05)
        diagnostics = client.received["/diagnostics"]
        for second in range(7, 40):
            message = Clock()
            message.clock.sec = second
            client.publish("/clock", message)
            client.spin(0.05)
        client.spin_until(lambda: bool(diagnostics))
        processes.check("uncertainty_node")
