"""Faults as they happen in an operating room, on the three live nodes as real processes.

    make faults

A simulated bag is played twice in a row, in real time, and each row of the table does one thing to it, to a
node or to the machine. A row: estimates and VALID ones, how many of those have the truth outside
[gap_min, gap_max] and by how much at worst; after the fault began, the time until a status that is not VALID,
or until silence that a deadline of 0.1 s notices; after it ended, the time until VALID again (a new track
needs travel first); and processes that died without being killed. Ends with 1 where a VALID estimate is
wrong, a process died, or a recorder whose disk was full did not say so, or lost what it received.
"""

import argparse
import contextlib
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench_faults import Recording, SeenEdges
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live_faults import EDGES, LEG_POSE, LENS_POSE, Fault, Sent, faults, serialized
from live_messages import LATENCY, with_stamp
from machine_faults import BusyCores, FullDisk
from rclpy.node import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage

from knee_gap_bringup.demo import NAMESPACE, START_TIMEOUT, scope_arguments
from knee_gap_bringup.launching.plan import NODES
from knee_gap_bringup.launching.processes import Processes, StartError, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.edges import EdgeState
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_msgs.msg import GapEdges, GapEstimate
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

sys.path.insert(0, str(Path(__file__).parents[1] / "test/system"))
from live import Client

DEADLINE = 0.1
KINDS = {IMAGE: CompressedImage, CAMERA_INFO: CameraInfo, BODY_POSE: PoseStamped, LEG_POSE: PoseStamped}
# What nodes publish, and something else as well.
FORGED = {EDGES: GapEdges, LENS_POSE: PoseWithCovarianceStamped}


class Heard(NamedTuple):
    """An estimate and when it came, after the first message [s]."""

    message: Any
    time: float


class Room:
    """The three nodes, a player and a listener."""

    def __init__(self, bag: Path, processes: Processes, client: Client, logs: Path) -> None:
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
        self.bag, self.processes, self.client, self.logs = bag, processes, client, logs
        self.settings: tuple[str, ...] = ()
        self.failed = False
        self.heard: dict[str, list[Heard]] = {"gap": [], "gap_edges": []}
        # Of what a second publisher said of an image: its stamp to that of the image.
        self.forged: dict[int, int] = {}
        self.began = 0.0
        self.outlets = {topic: self.outlet(topic) for topic in KINDS}
        self.second: Publisher | None = None
        self.fault = Fault("none")
        qos = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in (("gap", GapEstimate), ("gap_edges", GapEdges)):
            client.node.create_subscription(kind, topic, self._listener(topic), qos)
        for topic, kind in FORGED.items():
            client.node.create_subscription(
                kind, topic, lambda message, t=topic: self._forge(t, message), qos
            )

    def outlet(self, topic: str) -> Publisher:
        """A publisher of a topic."""
        qos = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
        return self.client.node.create_publisher({**KINDS, **FORGED}[topic], topic, qos)

    def start(self, node: str) -> None:
        """Start a node."""
        command = [executable(NODES[node], node), "--ros-args", "-r", f"__ns:={NAMESPACE}"]
        command += scope_arguments(node, self.bag)
        if node == "segmentation_node":
            command += ["-p", "image_transport:=compressed"]
        if node == "tracking_node":
            command += [word for setting in self.settings for word in ("-p", setting)]
        self.processes.start(node, command)

    def run(self, fault: Fault) -> str:
        """Play the bag with a fault; return its row."""
        if fault.settings != self.settings:
            self.settings = fault.settings
            self.processes.end("tracking_node")
            self.start("tracking_node")
            self.processes.wait_ready(["tracking_node"], START_TIMEOUT)
        sent = sorted(
            (one for each in self.script for one in fault.change(each)), key=lambda one: (one.due, one.stamp)
        )
        with contextlib.ExitStack() as stack:
            disk = stack.enter_context(FullDisk(self.processes, self.logs)) if fault.fills_disk else None
            self.client.spin(2.0)
            origins = self._play_with(fault, sent, disk)
        flaw = disk.flaw if disk is not None else ""
        return self._row(fault, origins, [flaw] if flaw else [])

    def _play_with(self, fault: Fault, sent: list[Sent], disk: FullDisk | None) -> dict[int, int]:
        """Play; return the stamps in the bag of the images, by the stamps with which they were sent [ns]."""
        # What was heard while nothing was played is timed by the row before.
        for known in self.heard.values():
            known.clear()
        self.forged.clear()
        self.began, offset_ns = time.monotonic(), time.time_ns()
        self.fault, self.second = fault, self.outlet(fault.second) if fault.second else None
        player = threading.Thread(target=self._play, args=(sent, offset_ns))
        player.start()
        with BusyCores() as cores:
            begun = ended = False
            while player.is_alive():
                self.client.spin(0.01)
                now = time.monotonic() - self.began
                if not begun and now >= fault.begin:
                    begun = True
                    self._begin(fault, cores, disk)
                if not ended and now >= fault.end:
                    ended = True
                    self._end(fault, cores, disk)
        self.client.spin(0.5)
        if self.second is not None:
            self.client.node.destroy_publisher(self.second)
        self.second = None
        return {round(one.stamp * 1e9) + offset_ns: one.origin_ns for one in sent if one.topic == IMAGE}

    def _begin(self, fault: Fault, cores: BusyCores, disk: FullDisk | None) -> None:
        if fault.node:
            kill = fault.name.startswith("SIGKILL")
            os.kill(self.processes.pid(fault.node), signal.SIGKILL if kill else signal.SIGSTOP)
        if fault.hogs:
            cores.begin()
        if disk is not None:
            disk.begin()

    def _end(self, fault: Fault, cores: BusyCores, disk: FullDisk | None) -> None:
        if fault.node and fault.name.startswith("SIGKILL"):
            self.processes.end(fault.node)
            self.start(fault.node)
        elif fault.node:
            os.kill(self.processes.pid(fault.node), signal.SIGCONT)
        cores.end()
        if disk is not None:
            disk.end()

    def _play(self, sent: list[Sent], offset_ns: int) -> None:
        fault = self.fault
        for one in sent:
            if (left := one.due - (time.monotonic() - self.began)) > 0.0:
                time.sleep(left)
            stamp = round(one.stamp * 1e9) + offset_ns
            self.outlets[one.topic].publish(with_stamp(one.data, stamp))
            if self.second is not None and one.topic == fault.second and fault.within(one):
                self.second.publish(with_stamp(fault.forge(one.data), stamp))

    def _forge(self, topic: str, message: Any) -> None:
        """Answer a node's message with one of a second publisher, while the fault is there."""
        now = time.monotonic() - self.began
        stamp = stamp_ns(message.header)
        if self.second is None or topic != self.fault.second or stamp in self.forged:
            return
        if self.fault.begin <= now < self.fault.end:
            data = self.fault.forge(serialized(message))
            seconds, rest = (int.from_bytes(data[place : place + 4], "little") for place in (4, 8))
            self.forged[seconds * 10**9 + rest] = stamp
            self.second.publish(data)

    def _listener(self, name: str) -> Callable[[Any], None]:
        def listen(message: Any) -> None:
            self.heard[name].append(Heard(message, time.monotonic() - self.began))

        return listen

    def _row(self, fault: Fault, origins: dict[int, int], flaws: list[str]) -> str:
        edges = {
            stamp_ns(one.message.header): one.message
            for one in self.heard["gap_edges"]
            if stamp_ns(one.message.header) not in self.forged
        }
        estimates = self.heard["gap"]
        valid = [one for one in estimates if one.message.status == GapStatus.VALID]
        misses = []
        for one in valid:
            stamp = stamp_ns(one.message.header)
            stamp = self.forged.get(stamp, stamp)
            if stamp in origins and stamp in edges:
                truth = self.recording.truth(origins[stamp], seen_edges(edges[stamp]))
                misses.append(max(one.message.gap_min - truth, truth - one.message.gap_max))
        wrong = [miss for miss in misses if miss > 0.0]
        died = [*self.died(), *flaws]
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
            except StartError as error:
                gone.append(str(error))
                self.processes.end(node)
                self.start(node)
        return gone


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
        room = Room(asked.bag, processes, client, Path(logs))
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
