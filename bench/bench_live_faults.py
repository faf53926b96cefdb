"""Faults as they happen in an operating room, on the three live nodes as real processes.

    make faults

A simulated bag is played twice in a row, in real time, and each row of the table does one thing to it or to a
node. A row: estimates and VALID ones, how many of those have the truth outside [gap_min, gap_max] and by how
much at worst; after the fault began, the time until a status that is not VALID, or until silence that a
deadline of 0.1 s notices; after it ended, the time until VALID again (a new track needs travel first); and
processes that died without being killed. Ends with 1 where a VALID estimate is wrong or a process died.
"""

import argparse
import itertools
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from bench_faults import Recording, SeenEdges
from geometry_msgs.msg import PoseStamped
from rclpy.node import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage

from knee_gap_bringup.demo import NAMESPACE, START_TIMEOUT, scope_arguments
from knee_gap_bringup.launching.plan import NODES
from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.edges import EdgeState
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_msgs.msg import GapEdges, GapEstimate
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

sys.path.insert(0, str(Path(__file__).parents[1] / "test/system"))
from live import Client

DEADLINE = 0.1
# How long after its stamp each message is received, as in the bag [s].
LATENCY = {IMAGE: 0.008, CAMERA_INFO: 0.008, BODY_POSE: 0.003}
KINDS = {IMAGE: CompressedImage, CAMERA_INFO: CameraInfo, BODY_POSE: PoseStamped}
BEGIN = 2.0  # of a fault, after the first message [s]


class Sent(NamedTuple):
    """A message as CDR, its stamp and time of sending after the first [s], and its stamp in the bag [ns]."""

    topic: str
    data: bytes
    stamp: float
    due: float
    origin_ns: int


Change = Callable[[Sent], Sequence[Sent]]


@dataclass
class Fault:
    """What happens from `begin` to `end` [s] to messages or a node; `blind`: no gap is known meanwhile."""

    name: str
    end: float = BEGIN
    change: Change = lambda sent: [sent]
    node: str = ""
    blind: bool = True
    second: str = ""
    begin: float = BEGIN

    def within(self, sent: Sent) -> bool:
        """Whether a message is sent while the fault is there."""
        return self.begin <= sent.due < self.end


def of(topic: str, change: Change, begin: float, end: float) -> Change:
    """Change the messages of one topic for a while."""

    def changed(sent: Sent) -> Sequence[Sent]:
        return change(sent) if sent.topic == topic and begin <= sent.due < end else [sent]

    return changed


def frozen() -> Change:
    """The first message again and again, with new stamps."""
    kept: list[bytes] = []

    def change(sent: Sent) -> Sequence[Sent]:
        kept.append(sent.data)
        return [sent._replace(data=kept[0])]

    return change


def every_other(change: Change) -> Change:
    """Change every second message."""
    turn = itertools.cycle([False, True])
    return lambda sent: change(sent) if next(turn) else [sent]


def later(seconds: float) -> Change:
    """Send a message later, with its stamp as it was."""
    return lambda sent: [sent._replace(due=sent.due + seconds)]


def stepped(seconds: float) -> Change:
    """Stamp a message by a clock that was set."""
    return lambda sent: [sent._replace(stamp=sent.stamp + seconds)]


def moved(metres: float) -> Change:
    """A pose elsewhere, as of another body."""

    def change(sent: Sent) -> Sequence[Sent]:
        message = deserialized(sent.data, PoseStamped)
        message.pose.position.x += metres
        return [sent._replace(data=serialized(message))]

    return change


def painted(paint: Callable[[Any], Any]) -> Change:
    """An image that is decoded, changed and encoded again."""
    known: dict[int, bytes] = {}

    def change(sent: Sent) -> Sequence[Sent]:
        if sent.origin_ns not in known:
            message = deserialized(sent.data, CompressedImage)
            pixels = paint(cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR))
            message.data = cv2.imencode(".jpg", pixels)[1].tobytes()
            known[sent.origin_ns] = serialized(message)
        return [sent._replace(data=known[sent.origin_ns])]

    return change


def deserialized(data: bytes, kind: type) -> Any:
    """A message of rclpy from CDR."""
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, kind)


def serialized(message: Any) -> bytes:
    """CDR of a message of rclpy."""
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def faults() -> list[Fault]:
    """The rows of the table."""

    def nothing(sent: Sent) -> Sequence[Sent]:
        return []

    def twice(sent: Sent) -> Sequence[Sent]:
        return [sent, sent]

    rows = [Fault("nothing", blind=False)]
    for node in NODES:
        rows.append(Fault(f"SIGKILL {node}, started again", BEGIN + 0.5, node=node))
        rows.append(Fault(f"SIGSTOP {node} 0.7 s", BEGIN + 0.7, node=node))
    for count in (1, 10, 100, 1000):
        end = BEGIN + count / 120
        rows.append(Fault(f"{count} poses lost", end, of(BODY_POSE, nothing, BEGIN, end), blind=count >= 10))
    end = BEGIN + 1.0
    for name, topic, change, blind in (
        ("poses 0.3 s late", BODY_POSE, later(0.3), True),
        ("poses in wrong order", BODY_POSE, every_other(later(0.012)), False),
        ("poses frozen", BODY_POSE, frozen(), True),
        ("poses of another body", BODY_POSE, moved(0.3), True),
        ("poses of two bodies in turn", BODY_POSE, every_other(moved(0.3)), False),
        ("poses doubled", BODY_POSE, twice, False),
        ("image frozen", IMAGE, frozen(), True),
        ("image black", IMAGE, painted(np.zeros_like), True),
        ("image white", IMAGE, painted(lambda pixels: np.full_like(pixels, 255)), True),
        ("every second image lost", IMAGE, every_other(nothing), False),
        ("images in wrong order", IMAGE, every_other(later(0.02)), False),
        ("images 0.3 s late", IMAGE, later(0.3), False),
        ("image of half the size", IMAGE, painted(lambda pixels: pixels[::2, ::2].copy()), True),
    ):
        rows.append(Fault(f"{name} 1 s", end, of(topic, change, BEGIN, end), blind=blind))
    for seconds in (0.1, -0.1):
        step = of(BODY_POSE, stepped(seconds), BEGIN, np.inf)
        rows.append(Fault(f"tracker's clock steps {1e3 * seconds:+g} ms", BEGIN, step, blind=False))
    rows.append(Fault("second publisher of poses, 5 mm off, 1 s", end, second=BODY_POSE, blind=False))
    rows.append(Fault("second publisher of images, black, 1 s", end, second=IMAGE, blind=False))
    return rows


class Heard(NamedTuple):
    """An estimate and when it came, after the first message [s]."""

    message: Any
    time: float


class Room:
    """The three nodes, a player and a listener."""

    def __init__(self, bag: Path, processes: Processes, client: Client) -> None:
        self.recording = Recording.read(bag)
        self.recording.messages = []
        with BagReader(bag) as reader:
            raw = [
                (one.topic, bytes(one.data), int(reader.stamp_ns(one) or 0))
                for one in reader.messages(list(LATENCY))
            ]
        first = min(stamp for _, _, stamp in raw)
        length = (max(stamp for _, _, stamp in raw) - first) / 1e9 + 1 / 120
        self.script = [
            Sent(topic, data, t := round_ * length + (stamp - first) / 1e9, t + LATENCY[topic], stamp)
            for round_ in (0, 1)
            for topic, data, stamp in raw
        ]
        self.bag, self.processes, self.client = bag, processes, client
        self.killed: set[str] = set()
        qos = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
        self.outlets = {topic: self._outlet(topic, qos) for topic in KINDS}
        for name, kind in (("gap", GapEstimate), ("gap_edges", GapEdges)):
            client.node.create_subscription(kind, name, self._listener(name), qos)
        self.heard: dict[str, list[Heard]] = {"gap": [], "gap_edges": []}
        self.began = 0.0

    def _outlet(self, topic: str, qos: QoSProfile) -> Publisher:
        return self.client.node.create_publisher(KINDS[topic], topic, qos)

    def _listener(self, name: str) -> Callable[[Any], None]:
        return lambda message: self.heard[name].append(Heard(message, time.monotonic() - self.began))

    def start(self, node: str) -> None:
        """Start a node."""
        command = [executable(NODES[node], node), "--ros-args", "-r", f"__ns:={NAMESPACE}"]
        command += scope_arguments(node, self.bag)
        if node == "segmentation_node":
            command += ["-p", "image_transport:=compressed"]
        self.processes.start(node, command)

    def run(self, fault: Fault) -> str:
        """Play the bag with a fault; return its row."""
        sent = sorted(
            (one for each in self.script for one in fault.change(each)), key=lambda one: (one.due, one.stamp)
        )
        for known in self.heard.values():
            known.clear()
        self.client.spin(2.0)
        self.began, offset_ns = time.monotonic(), time.time_ns()
        second = self._outlet(fault.second, QoSProfile(depth=64)) if fault.second else None
        black = painted(np.zeros_like) if fault.second == IMAGE else moved(0.005)
        player = threading.Thread(target=self._play, args=(sent, offset_ns, fault, second, black))
        player.start()
        acted = 0
        while player.is_alive():
            self.client.spin(0.01)
            now = time.monotonic() - self.began
            if fault.node and acted == 0 and now >= fault.begin:
                kill = fault.name.startswith("SIGKILL")
                os.kill(self.processes.pid(fault.node), signal.SIGKILL if kill else signal.SIGSTOP)
                acted = 1
            if fault.node and acted == 1 and now >= fault.end:
                if fault.name.startswith("SIGKILL"):
                    self.processes.end(fault.node)
                    self.start(fault.node)
                else:
                    os.kill(self.processes.pid(fault.node), signal.SIGCONT)
                acted = 2
        self.client.spin(0.5)
        if second is not None:
            self.client.node.destroy_publisher(second)
        origins = {round(one.stamp * 1e9) + offset_ns: one.origin_ns for one in sent if one.topic == IMAGE}
        return self._row(fault, origins)

    def _play(
        self, sent: list[Sent], offset_ns: int, fault: Fault, second: Publisher | None, change: Change
    ) -> None:
        for one in sent:
            if (left := one.due - (time.monotonic() - self.began)) > 0.0:
                time.sleep(left)
            self.outlets[one.topic].publish(stamped(one, offset_ns))
            if second is not None and one.topic == fault.second and fault.within(one):
                for other in change(one):
                    second.publish(stamped(other, offset_ns))

    def _row(self, fault: Fault, origins: dict[int, int]) -> str:
        edges = {stamp_of(one.message): one.message for one in self.heard["gap_edges"]}
        estimates = self.heard["gap"]
        valid = [one for one in estimates if one.message.status == GapStatus.VALID]
        misses = []
        for one in valid:
            stamp = stamp_of(one.message)
            if stamp in origins and stamp in edges:
                truth = self.recording.truth(origins[stamp], seen_edges(edges[stamp]))
                misses.append(max(one.message.gap_min - truth, truth - one.message.gap_max))
        wrong = [miss for miss in misses if miss > 0.0]
        died = self.died()
        self.failed = bool(wrong or died)
        worst = f"{len(wrong)}, by {1e3 * max(wrong, default=0.0):.2f} mm"
        delay = f"{1e3 * self._delay_of_status(fault, estimates):.0f} ms" if fault.blind else "-"
        again = next((one.time - fault.end for one in valid if one.time > fault.end), np.nan)
        recovery = f"{again:.1f} s" if fault.name != "nothing" else "-"
        return (
            f"| {fault.name} | {len(valid)} of {len(estimates)} | {worst} | {delay} | {recovery} | "
            f"{', '.join(died) or '0'} |"
        )

    def _delay_of_status(self, fault: Fault, estimates: list[Heard]) -> float:
        """Time from the begin of a fault to a status that is not VALID, or to a noticed silence [s]."""
        before = max((one.time for one in estimates if one.time <= fault.begin), default=fault.begin)
        for one in estimates:
            if one.time <= fault.begin:
                continue
            if one.time - before > DEADLINE:
                return max(before + DEADLINE - fault.begin, 0.0)
            if one.message.status != GapStatus.VALID:
                return one.time - fault.begin
            before = one.time
        return max(before + DEADLINE - fault.begin, 0.0)

    def died(self) -> list[str]:
        """Nodes that are not running; they are started again."""
        gone = []
        for node in NODES:
            try:
                self.processes.check(node)
            except RuntimeError as error:
                gone.append(str(error))
                self.processes.end(node)
                self.start(node)
        return gone


def stamp_of(message: Any) -> int:
    """Stamp [ns] of a message of rclpy."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def stamped(sent: Sent, offset_ns: int) -> bytes:
    """The message as CDR with its stamp by the present clock: a header stands first in each of them."""
    seconds, rest = divmod(round(sent.stamp * 1e9) + offset_ns, 10**9)
    return sent.data[:4] + seconds.to_bytes(4, "little") + rest.to_bytes(4, "little") + sent.data[12:]


def seen_edges(message: Any) -> SeenEdges:
    """Edges that a message shows, as `bench_faults` has them."""
    bearings = np.array([[one.x, one.y, one.z] for one in (message.edge_0, message.edge_1)])
    if not message.edge_state_0 == message.edge_state_1 == EdgeState.SEEN:
        bearings[:] = np.nan
    return SeenEdges(bearings, np.array([message.pixel_0, message.pixel_1]))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="bench_live_faults", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bag", nargs="?", type=Path, default=Path("bags/sample"))
    parser.add_argument("--only", nargs="+", default=[""], help="faults whose name holds one of these")
    asked = parser.parse_args(argv)
    domain, failed = 70 + os.getpid() % 20, False
    environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with (
        tempfile.TemporaryDirectory() as logs,
        Processes(Path(logs), environment) as processes,
        Client(domain, NAMESPACE) as client,
    ):
        room = Room(asked.bag, processes, client)
        for node in NODES:
            room.start(node)
        processes.wait_ready(list(NODES), START_TIMEOUT)
        print(f"{asked.bag}, load of the machine {os.getloadavg()[0]:.1f}\n")
        print("| fault | VALID | truth outside [min, max] | status after | VALID again after | died |")
        print("|---|---|---|---|---|---|")
        for fault in faults():
            if any(part in fault.name for part in asked.only):
                print(room.run(fault), flush=True)
                failed |= room.failed
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
