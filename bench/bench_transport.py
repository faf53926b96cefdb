"""Images at 60 Hz through segmentation_node as real processes, beside a node that only receives and decodes.

A bag is played in real time; every image should give one gap_edges. Latency is from the moment a recorder
receives the image's camera_info, which is played with it, to the moment it receives the edges. With --all the
two other nodes run as well, and the poses of the lens guide the search; with --suite all in one process.
Without a bag the sample is played forwards and backwards for as long as asked.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knee_gap_bringup.launching.processes import Processes, StartError, executable
from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.stamps import set_stamp, stamp_ns
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE, PARAMETERS_FILE

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "bags" / "sample"
EDGES, GAP = "/knee_gap/gap_edges", "/knee_gap/gap"
TICKS = os.sysconf("SC_CLK_TCK")
NODES = {
    "segmentation_node": "knee_gap_perception",
    "tracking_node": "knee_gap_perception",
    "uncertainty_node": "knee_gap_uncertainty",
}
SUITE = "suite_node"


class Run(NamedTuple):
    """Counts, latencies [s] of the edges, and the share of one core that each process took."""

    sent: int
    edges: int
    valid: int
    latencies: list[float]
    cores: dict[str, float]


def main(argv: Sequence[str] | None = None) -> int:
    """Play, count and print; 1 where something did not start."""
    parser = argparse.ArgumentParser(prog="bench_transport", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bag", type=Path, nargs="?", help="bag to play; without it the sample, to and fro")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the sample, to and fro")
    parser.add_argument("--all", action="store_true", help="tracking_node and uncertainty_node as well")
    parser.add_argument("--suite", action="store_true", help="all three nodes in one process (suite_node)")
    parser.add_argument("--domain", type=int, default=77, help="ROS_DOMAIN_ID")
    asked = parser.parse_args(argv)
    try:
        with tempfile.TemporaryDirectory() as folder:
            bag = asked.bag or to_and_fro(Path(folder) / "bag", asked.seconds)
            floor = run(bag, Path(folder) / "floor", asked.domain, ["floor"])
            nodes = list(NODES) if asked.all else ["segmentation_node"]
            nodes = [SUITE] if asked.suite else nodes
            full = run(bag, Path(folder) / "nodes", asked.domain, nodes)
    except (BagError, StartError, OSError) as error:
        print(f"bench_transport: {error}", file=sys.stderr)
        return 1
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; at 60 Hz an image comes every 16.7 ms")
    print_run("receive and decode only", floor)
    print_run(", ".join(nodes), full)
    return 0


def to_and_fro(path: Path, seconds: float) -> Path:
    """A bag of the sample's images and poses, forwards and backwards by turns, with stamps that run on."""
    with BagReader(SAMPLE) as reader:
        played = [
            (entry, reader.stamp_ns(entry)) for entry in reader.messages([IMAGE, CAMERA_INFO, BODY_POSE])
        ]
        stamps = [stamp for _, stamp in played if stamp is not None]
        begin, length = min(stamps), max(stamps) - min(stamps) + 8_333_333
        with BagWriter(path, metadata=reader.metadata) as writer:
            for topic, kind in reader.topics.items():
                if topic in (IMAGE, CAMERA_INFO, BODY_POSE):
                    writer.add_topic(topic, kind, "sensor")
            pending = []
            for turn in range(int(np.ceil(seconds * 1e9 / length))):
                for entry, stamp in played:
                    assert stamp is not None
                    since = stamp - begin if turn % 2 == 0 else length - 8_333_333 - (stamp - begin)
                    new = begin + turn * length + since
                    if new - begin < seconds * 1e9:
                        pending.append((new + entry.time_ns - stamp, new, entry))
            for time_ns, new, entry in sorted(pending, key=lambda item: (item[0], item[2].topic)):
                message = reader.deserialize(entry)
                set_stamp(message.header, new)
                writer.write(entry.topic, message, time_ns)
    (path / PARAMETERS_FILE).write_bytes((SAMPLE / PARAMETERS_FILE).read_bytes())
    return path


def run(bag: Path, out: Path, domain: int, nodes: Sequence[str]) -> Run:
    """Play a bag through nodes; raises StartError where one does not come up or ends."""
    out.mkdir()
    recording = out / "recording"
    environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with Processes(out, environment) as processes:
        record = [executable("knee_gap_replay", "record"), str(recording), EDGES, CAMERA_INFO]
        processes.start("record", record)
        for node in nodes:
            processes.start(node, command(node, bag))
        processes.wait_ready(nodes, 120.0)
        before = {name: cpu_seconds(processes.pid(name)) for name in [*nodes, "record"]}
        tracks = "tracking_node" in nodes or SUITE in nodes
        topics = [IMAGE, CAMERA_INFO, *([BODY_POSE] if tracks else [])]
        play = [executable("knee_gap_replay", "play"), str(bag), "--topics", *topics, "--delay", "1"]
        processes.start("play", [*play, "--wait-for", *topics])
        if processes.wait("play") != 0:
            raise StartError(f"play failed: {processes.last_words('play')}")
        time.sleep(1.0)
        spent = {name: cpu_seconds(processes.pid(name)) - seconds for name, seconds in before.items()}
        for node in nodes:
            processes.check(node)
        processes.end("record")
    return counted(bag, recording, spent)


def command(node: str, bag: Path) -> list[str]:
    """How a node is started."""
    if node == "floor":
        floor = str(Path(__file__).with_name("decode_only.py"))
        return [sys.executable, floor, "--ros-args", "-r", "__ns:=/knee_gap"]
    started = [executable(NODES.get(node, "knee_gap_bringup"), node), "--ros-args", "-r", "__ns:=/knee_gap"]
    if node == "segmentation_node":
        started += ["-p", "image_transport:=compressed"]
    if node != "uncertainty_node":
        started += ["--params-file", str(bag / PARAMETERS_FILE)]
    return started


def cpu_seconds(pid: int) -> float:
    """Processor time [s] that a process has taken so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def counted(bag: Path, recording: Path, spent: dict[str, float]) -> Run:
    """What the recording holds, against what was played."""
    with BagReader(bag) as reader:
        sent = reader.count([IMAGE]) or 0
    heard: dict[int, int] = {}
    latencies, edges, valid = [], 0, 0
    with BagReader(recording) as reader:
        for entry in reader.messages():
            message = reader.deserialize(entry)
            stamp = stamp_ns(message.header)
            if entry.topic == CAMERA_INFO:
                heard[stamp] = entry.time_ns
            else:
                edges += 1
                valid += int(message.status == 1)
                if stamp in heard:
                    latencies.append((entry.time_ns - heard[stamp]) * 1e-9)
    seconds = sent / 60.0
    return Run(sent, edges, valid, latencies, {name: cpu / seconds for name, cpu in spent.items()})


def print_run(name: str, result: Run) -> None:
    """Print a run."""
    lost = result.sent - result.edges
    print(
        f"{name}: {result.sent} images sent, {result.edges} gap_edges received, {lost} lost, "
        f"{result.valid} valid"
    )
    if result.latencies:
        p50, p99 = 1e3 * np.percentile(result.latencies, [50, 99])
        print(f"  latency p50 {p50:.1f} ms  p99 {p99:.1f} ms")
    print("  cores: " + ", ".join(f"{process} {share:.2f}" for process, share in result.cores.items()))


if __name__ == "__main__":
    sys.exit(main())
