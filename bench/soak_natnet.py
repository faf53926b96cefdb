"""The NatNet client against the simulated server for minutes: no crash, no invalid pose valid, stamps right.

    tools/env python bench/soak_natnet.py --minutes 10 --rate 240

The server runs in its own process, with lost frames, invalid bits, occlusions, swapped labels, jitter and
restarts, with --jumps frozen poses and jumps as well; its clock body gives the true time of each exposure,
and the scene the true pose of the scope. Ends with 1 where a stamp was off by a millisecond or more, or a
pose was called valid that was not the scope's.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Sequence

import numpy as np

from knee_gap_core.values.poses import LensPose
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.trackers.body_source import BodyFrame, choose_body
from knee_gap_perception.trackers.natnet.client import NatNetClient, NatNetParameters
from knee_gap_simulation.natnet.scene import CLOCK_SECONDS, TrackedScene

NAMES = ("scope", "tibia", "clock")
GROUP = "239.255.42.98"
WORST_STAMP = 1e-3
WORST_POSE = 1e-3


def server_command(arguments: argparse.Namespace) -> list[str]:
    faults = {
        "--lose": 0.005,
        "--invalid": 0.01,
        "--occlude-every": 7.0,
        "--swap-every": 11.0,
        "--jitter-ms": 0.5,
        "--restart-every": 45.0,
        "--down-for": 4.0,
    }
    module = "knee_gap_simulation.natnet.command"
    command = [sys.executable, "-m", module, "--version", arguments.version, "--rate", str(arguments.rate)]
    command += ["--command-port", str(arguments.port), "--data-port", str(arguments.port + 1)]
    if arguments.jumps:
        faults |= {"--freeze-every": 13.0, "--jump-every": 17.0}
    if arguments.multicast:
        command += ["--multicast", GROUP]
    return command + [str(part) for fault in faults.items() for part in fault]


class Watch:
    """What was seen so far."""

    def __init__(self) -> None:
        self.scene = TrackedScene(NAMES)
        # Judged is the body: where the lens sits on it does not matter.
        self.tracker = ScopeTracker(TrackingParameters(body_to_shaft_translation=(0.0, 0.0, 0.0)))
        self.frames = 0
        self.stamp_errors: list[float] = []
        self.worst_pose = 0.0
        self.backwards = 0
        self._last_ns = 0

    def take(self, frame: BodyFrame) -> None:
        """Compare a frame with the truth."""
        self.frames += 1
        self.backwards += frame.stamp_ns <= self._last_ns
        self._last_ns = frame.stamp_ns
        clock, _ = choose_body(frame, "clock")
        if clock is not None:
            shown = float(clock.position[0]) * CLOCK_SECONDS
            off = frame.stamp_ns % round(CLOCK_SECONDS * 1e9) / 1e9 - shown
            self.stamp_errors.append(abs((off + CLOCK_SECONDS / 2) % CLOCK_SECONDS - CLOCK_SECONDS / 2))
        body, others = choose_body(frame, "scope")
        if body is not None and isinstance(self.tracker.update(body, others), LensPose):
            x, y, z = self.scene.true_pose(1, frame.stamp_ns / 1e9)[0]
            self.worst_pose = max(self.worst_pose, float(np.linalg.norm(body.position - [x, -z, y])))


def memory_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=240.0)
    parser.add_argument("--version", default="4.1")
    parser.add_argument("--jumps", action="store_true", help="frozen poses and jumps as well")
    parser.add_argument("--multicast", action="store_true")
    parser.add_argument("--port", type=int, default=15410)
    arguments = parser.parse_args(argv)
    watch, end, printed = Watch(), time.monotonic() + arguments.minutes * 60.0, time.monotonic()
    server = subprocess.Popen(server_command(arguments), stdout=subprocess.DEVNULL)
    try:
        parameters = NatNetParameters(command_port=arguments.port, multicast_address=GROUP)
        with NatNetClient(parameters) as client:
            while time.monotonic() < end:
                for frame in client.poll(0.02):
                    watch.take(frame)
                if time.monotonic() - printed > 30.0:
                    printed = time.monotonic()
                    print(
                        f"{watch.frames} frames, {memory_mib():.0f} MiB, {client.status().words}", flush=True
                    )
            counts = dict(client.session.counts)
    finally:
        server.terminate()
        server.wait()
    errors = np.array(watch.stamp_errors) * 1e3
    median, high, worst = np.quantile(errors, [0.5, 0.999, 1.0])
    print(f"client: {counts}")
    print(f"refused: { ({str(reason): count for reason, count in watch.tracker.validity.counts.items()}) }")
    print(
        f"{watch.frames} frames, {watch.tracker.accepted_count} valid poses, "
        f"worst {watch.worst_pose * 1e3:.2f} mm off; "
        f"stamps off by {median:.4f} ms (median), {high:.4f} (99.9 %), {worst:.4f} (worst); "
        f"{watch.backwards} backwards; {memory_mib():.0f} MiB"
    )
    failed = worst >= WORST_STAMP * 1e3 or watch.worst_pose >= WORST_POSE or watch.backwards
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
