"""A minute live: images lost, time from stamp to gap, and what each node takes, beside a bare subscriber.

A camera (60 Hz) and a tracker (120 Hz) send the sample bag, forwards and backwards, with present stamps: an
image is received 8 ms after its stamp, a pose 3 ms. In the same run a node that only receives and decodes
answers the same images. Rows: one scope at 1280x720, one at 1920x1080, two at once, in two namespaces.
"Lost" are images without an estimate or an answer; cores and memory are those of each node; growth is that of
the second half of the run over the first (cores), and from a quarter of the run to its end (memory).
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bench_transport import NODES, ROOT, SAMPLE, cpu_seconds

from knee_gap_bringup.launching.processes import Processes, StartError, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_simulation.recordings.recording import PARAMETERS_FILE

FLOOR, FLOOR_TOPIC = "bare subscriber", "/floor/gap_edges"
PAGE = os.sysconf("SC_PAGE_SIZE")
# What the nodes still answer after the last image [s].
DRAIN = 1.0


class Scene(NamedTuple):
    """A row: its name, the height of its images [px] (0: the bag's), and the scopes' namespaces."""

    name: str
    rows: int = 0
    spaces: tuple[str, ...] = ("/knee_gap",)


class Sample(NamedTuple):
    """What a process has taken by a time [s]: processor time [s], and memory [MB]."""

    time: float
    cpu: float
    memory: float


SCENES = (
    Scene("1280x720"),
    Scene("1920x1080", 1080),
    Scene("two scopes", 0, ("/knee_gap", "/knee_gap_2")),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows; 1 where something did not start."""
    parser = argparse.ArgumentParser(prog="bench_load", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each row")
    parser.add_argument("--only", nargs="+", default=[""], help="rows whose name holds one of these")
    asked = parser.parse_args(argv)
    domain = 90 + os.getpid() % 10
    for scene in SCENES:
        if not any(part in scene.name for part in asked.only):
            continue
        print(f"{scene.name}, {asked.seconds:g} s, load of the machine {os.getloadavg()[0]:.1f}", flush=True)
        try:
            with tempfile.TemporaryDirectory() as folder:
                run(scene, Path(folder), asked.seconds, domain)
        except (BagError, StartError, OSError) as error:
            print(f"bench_load: {error}", file=sys.stderr)
            return 1
    return 0


def run(scene: Scene, folder: Path, seconds: float, domain: int) -> None:
    """Run one row and print it. Raises StartError where a process does not start, or ends."""
    environment = {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONPATH": os.pathsep.join([str(ROOT / "bench"), os.environ.get("PYTHONPATH", "")]),
    }
    recording, stamps = folder / "recording", folder / "stamps.json"
    with Processes(folder, environment) as processes:
        gaps = [f"{space}/gap" for space in scene.spaces]
        processes.start(
            "record", [executable("knee_gap_replay", "record"), str(recording), *gaps, FLOOR_TOPIC]
        )
        nodes = {
            f"{node}{space.removeprefix('/knee_gap')}": (node, space)
            for space in scene.spaces
            for node in NODES
        }
        for name, (node, space) in nodes.items():
            processes.start(name, command(node, space))
        floor = [sys.executable, str(ROOT / "bench/decode_only.py"), "--ros-args", "-r", "__ns:=/knee_gap"]
        processes.start(FLOOR, [*floor, "-r", f"gap_edges:={FLOOR_TOPIC}"])
        processes.wait_ready([*nodes, FLOOR], 120.0)
        send = [sys.executable, str(ROOT / "bench/send_live.py"), str(SAMPLE), str(stamps)]
        send += ["--seconds", str(seconds), "--rows", str(scene.rows), "--namespaces", *scene.spaces]
        processes.start("send", send)
        processes.wait_ready(["send"], 120.0)
        samples = watch(processes, [*nodes, FLOOR], seconds)
        if processes.wait("send", beside=[*nodes, FLOOR]) != 0:
            raise StartError(f"sending failed: {processes.last_words('send')}")
        time.sleep(DRAIN)
        processes.end("record")
    report(recording, json.loads(stamps.read_text()), gaps, samples)


def command(node: str, space: str) -> list[str]:
    """How a node is started; of two scopes, the frames of the second have names of their own."""
    started = [executable(NODES[node], node), "--ros-args", "-r", f"__ns:={space}"]
    if node == "segmentation_node":
        started += ["-p", "image_transport:=compressed"]
    if node != "uncertainty_node":
        started += ["--params-file", str(SAMPLE / PARAMETERS_FILE)]
    if node == "tracking_node" and space != "/knee_gap":
        started += ["-p", "body_frame_id:=scope_body_2", "-p", "child_frame_id:=arthroscope_optical_2"]
    return started


def watch(processes: Processes, names: Sequence[str], seconds: float) -> dict[str, list[Sample]]:
    """Sample the processes at the begin, a quarter, a half and the end of the run."""
    samples: dict[str, list[Sample]] = {name: [] for name in names}
    begin = time.monotonic()
    for share in (0.05, 0.25, 0.5, 1.0):
        time.sleep(max(begin + share * seconds - time.monotonic(), 0.0))
        for name, taken in samples.items():
            processes.check(name)
            pid = processes.pid(name)
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            taken.append(Sample(time.monotonic(), cpu_seconds(pid), pages * PAGE / 1e6))
    return samples


def report(recording: Path, sent: list[int], gaps: Sequence[str], samples: dict[str, list[Sample]]) -> None:
    """Print what became of the images, and what each process took."""
    delays: dict[str, dict[int, float]] = {topic: {} for topic in (*gaps, FLOOR_TOPIC)}
    valid: dict[str, int] = dict.fromkeys(gaps, 0)
    wanted = set(sent)
    with BagReader(recording) as reader:
        for entry in reader.messages():
            message = reader.deserialize(entry)
            stamp = stamp_ns(message.header)
            # Estimates that say that no image came have stamps of their own.
            if stamp in wanted:
                delays[entry.topic].setdefault(stamp, 1e-6 * (entry.time_ns - stamp))
                if entry.topic in valid:
                    valid[entry.topic] += message.status == GapStatus.VALID
    for topic, delay in delays.items():
        words = f", {valid[topic]} valid" if topic in valid else ""
        p50, p99 = np.percentile(list(delay.values()), [50, 99]) if delay else (np.nan, np.nan)
        print(
            f"  {topic}: {len(sent)} images, {len(sent) - len(delay)} lost{words}; "
            f"from stamp to answer p50 {p50:.1f} ms, p99 {p99:.1f} ms"
        )
    for name, (first, quarter, half, last) in samples.items():
        early = (half.cpu - first.cpu) / (half.time - first.time)
        late = (last.cpu - half.cpu) / (last.time - half.time)
        whole = (last.cpu - first.cpu) / (last.time - first.time)
        grown = (last.memory - quarter.memory) * 60.0 / (last.time - quarter.time)
        print(
            f"  {name}: {whole:.2f} cores ({late - early:+.2f}), "
            f"{last.memory:.0f} MB ({grown:+.1f} MB a minute)"
        )
    total = sum(
        (taken[-1].cpu - taken[0].cpu) / (taken[-1].time - taken[0].time)
        for name, taken in samples.items()
        if name != FLOOR
    )
    print(f"  all nodes: {total:.2f} cores", flush=True)


if __name__ == "__main__":
    sys.exit(main())
