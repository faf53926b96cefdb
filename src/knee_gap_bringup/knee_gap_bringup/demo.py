"""The demo: a bag played in real time to the live nodes over DDS, and their output compared with truth."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from knee_gap_bringup.gap_plot import write_gap_plot
from knee_gap_bringup.launching.plan import DRAIN, NODES, parameter_arguments, scope_parameters
from knee_gap_bringup.launching.processes import Processes, StartError, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.arguments import Parser, finite
from knee_gap_core.values.errors import KneeGapError
from knee_gap_replay.report.comparison import EDGES, GAP, compare
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE, PARAMETERS_FILE

NAMESPACE = "/knee_gap"
RECORDED = (
    EDGES,
    f"{NAMESPACE}/scope_pose",
    f"{NAMESPACE}/scope_calibration",
    GAP,
    *(f"{GAP}/{name}" for name in ("min", "max", "snr")),
)
# A bag folder; its file is gap_0.mcap.
RECORDING = "gap"
# Time allowed for the nodes to start [s]: the first start after a build compiles the kernels.
START_TIMEOUT = 120.0
# Longest time that segmentation_node waits for the pose after an image [s].
LONGEST_POSE_WAIT = 0.1


def play_through_nodes(bag: Path, out: Path, begin: float, rate: float = 1.0) -> Path:
    """Play `bag` through the live nodes; return the recording of their output. Raises StartError."""
    recording = out / RECORDING
    # A ROS domain of its own, so that it does not receive from another demo or a robot on this machine.
    domain = os.environ.get("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    with Processes(out, {"ROS_DOMAIN_ID": domain}) as processes:
        processes.start(
            "record", [executable("knee_gap_replay", "record"), str(recording), *RECORDED, "--force"]
        )
        for node, package in NODES.items():
            command = [executable(package, node), "--ros-args", "-r", f"__ns:={NAMESPACE}"]
            if rate != 1.0:
                # Waiting times are then measured by the bag's clock.
                command += ["-p", "use_sim_time:=true"]
            command += scope_arguments(node, bag)
            if node == "segmentation_node":
                # Of a recording every image is wanted, however late it is answered.
                command += ["-p", "image_transport:=compressed", "-p", "max_image_lag:=0.0"]
                if rate < 1.0:
                    # Played slowly so that nothing is lost: no pose is to arrive too late either.
                    command += ["-p", f"max_pose_wait:={LONGEST_POSE_WAIT}"]
            processes.start(node, command)
        processes.wait_ready(list(NODES), START_TIMEOUT)
        topics = [IMAGE, CAMERA_INFO, BODY_POSE]
        # Two seconds for the nodes and the recorder to discover each other.
        play = [executable("knee_gap_replay", "play"), str(bag), "--topics", *topics, "--delay", "2"]
        if rate != 1.0:
            play += ["--clock", "--rate", str(rate)]
        processes.start("play", [*play, "--wait-for", *topics])
        pace = "in real time" if rate == 1.0 else f"at {rate:g} times its rate"
        print(
            f"demo: nodes ready after {time.monotonic() - begin:.1f} s; playing {bag.name} {pace}", flush=True
        )
        # A node that dies ends the demo at once, with its exit code.
        if (code := processes.wait("play", beside=[*NODES, "record"])) != 0:
            raise StartError(f"play failed: {processes.last_words('play')}", code)
        time.sleep(DRAIN)
        for node in NODES:
            processes.check(node)
        if processes.end("record") != 0:
            print(f"demo: {processes.last_words('record')}", file=sys.stderr)
    return recording


def scope_arguments(node: str, bag: Path) -> list[str]:
    """Command line arguments that describe the scope to a node: the bag's calibration, or the nominal one."""
    return list(parameter_arguments(scope_parameters(bag, node)))


def run(bag: Path, out: Path, rate: float) -> None:
    """Play, record, compare and draw."""
    begin = time.monotonic()
    with BagReader(bag) as reader:  # raises if it is not a bag, before anything is started or removed
        if missing := {IMAGE, CAMERA_INFO, BODY_POSE} - set(reader.topics):
            raise BagError(f"{bag} has no topic {', '.join(sorted(missing))}")
    if not (bag / PARAMETERS_FILE).is_file():
        raise BagError(f"{bag} has no {PARAMETERS_FILE} with the pose of the lens on the tracked body")
    out.mkdir(parents=True, exist_ok=True)
    recording = play_through_nodes(bag, out, begin, rate)
    comparison = compare(bag, recording)
    write_gap_plot(comparison, out / "gap.png", f"knee_gap, live: {bag.name}")
    print(f"demo: {recording} and {out / 'gap.png'} written, {time.monotonic() - begin:.1f} s in all")
    print(f"demo: {comparison.summary()}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; return 0 if it ran to the end."""
    parser = Parser(prog="demo", description=__doc__)
    parser.add_argument("--bag", type=Path, default=Path("bags/sample"), help="simulated bag to play")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder of the results")
    parser.add_argument("--rate", type=finite, default=1.0, help="times as fast as recorded")
    arguments = parser.parse_args(argv)
    # A signal that ends the demo, from Ctrl-C or otherwise, ends its processes with it.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if not 0.01 <= arguments.rate <= 100.0:
            raise StartError(f"--rate must lie in [0.01, 100], not {arguments.rate:g}")
        run(arguments.bag, arguments.out, arguments.rate)
    except StartError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.code
    except (KneeGapError, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
