"""The command `natnet_server`: a NatNet server on the loopback that behaves like Motive, faults included.

It is for tests and demonstrations of the tracking without a tracker.
"""

import argparse
import sys
import time
from collections.abc import Sequence

from knee_gap_core.node.command_line import Parser, finite, not_negative, positive, stop_on_signals
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.natnet import packets
from knee_gap_simulation.natnet.scene import Faults, TrackedScene
from knee_gap_simulation.natnet.server import HOST, NatNetServer, ServerSettings


def _version(text: str) -> packets.Version:
    major, _, minor = text.partition(".")
    if not (major.isdecimal() and minor.isdecimal()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a version such as 4.1")
    return int(major), int(minor)


def _port(text: str) -> int:
    if not (text.isdecimal() and len(text) < 6 and 0 < int(text) < 65536):
        raise argparse.ArgumentTypeError(f"'{text}' is not a port, 1 to 65535")
    return int(text)


def _parser() -> Parser:
    parser = Parser(prog="natnet_server", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--version", type=_version, default=(4, 1), help="NatNet version: 3.0, 3.1, 4.0 or 4.1 (4.1)")
    add("--claim-version", type=_version, help="version reported to clients, if not the one that is sent")
    add(
        "--body", action="append", dest="bodies", help="name of a body; can be repeated (scope, tibia, clock)"
    )
    add("--rate", type=positive, default=240.0, help="frames per second (240)")
    add("--command-port", type=_port, default=1510)
    add("--data-port", type=_port, default=1511, help="port of multicast data")
    add("--multicast", metavar="GROUP", help="send by multicast to this group, such as 239.255.42.99")
    add("--latency-ms", type=not_negative, default=4.0, help="time from exposure to sending (4)")
    add("--jitter-ms", type=not_negative, default=0.0, help="mean of the additional random delay (0)")
    add("--drift-ppm", type=finite, default=40.0, help="clock rate error, above 0 if fast (40)")
    add("--lose", type=not_negative, default=0.0, metavar="SHARE", help="fraction of lost frames (0)")
    add("--invalid", type=not_negative, default=0.0, metavar="SHARE", help="fraction of untracked poses (0)")
    add(
        "--occlude-every",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="interval of occlusions of the first body",
    )
    add("--occlude-for", type=not_negative, default=0.3, metavar="S")
    add(
        "--swap-every",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="interval of swapping the first two labels",
    )
    add("--swap-for", type=not_negative, default=0.5, metavar="S")
    add(
        "--freeze-every",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="interval of repeating the first body's pose, marked as valid",
    )
    add("--freeze-for", type=not_negative, default=0.5, metavar="S")
    add(
        "--jump-every",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="interval of reporting a reflection as the first body",
    )
    add("--jump-for", type=not_negative, default=0.5, metavar="S")
    add("--restart-every", type=not_negative, default=0.0, metavar="S", help="interval between restarts")
    add("--down-for", type=not_negative, default=3.0, metavar="S")
    add("--duration", type=not_negative, default=0.0, metavar="S", help="end after this time (never)")
    add("--seed", type=int, default=0)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server until its duration is over or it is stopped."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    try:
        server = _server(arguments)
    except SimulationError as error:
        parser.error(str(error))
    except OSError as error:
        print(f"natnet_server: the ports cannot be used: {error.strerror or error}", file=sys.stderr)
        return 1
    stop = stop_on_signals()
    settings = server.settings
    group = settings.multicast_address
    way = f"multicast {group}:{settings.data_port}" if group else "unicast"
    print(
        f"natnet_server: NatNet {'.'.join(map(str, settings.version))} on {HOST}:{settings.command_port}, "
        f"{way}, {settings.rate:g} Hz, bodies {', '.join(server.scene.names)}",
        flush=True,
    )
    end = time.monotonic() + arguments.duration if arguments.duration else float("inf")
    with server:
        while not stop.is_set() and time.monotonic() < end:
            server.step()
    print(f"natnet_server: {server.counts.frames} frames, {server.counts.restarts} restarts", flush=True)
    return 0


def _server(arguments: argparse.Namespace) -> NatNetServer:
    faults = Faults(
        lost_share=arguments.lose,
        invalid_share=arguments.invalid,
        occlusion_period=arguments.occlude_every,
        occlusion_length=arguments.occlude_for,
        swap_period=arguments.swap_every,
        swap_length=arguments.swap_for,
        freeze_period=arguments.freeze_every,
        freeze_length=arguments.freeze_for,
        jump_period=arguments.jump_every,
        jump_length=arguments.jump_for,
    )
    names = tuple(arguments.bodies or ("scope", "tibia", "clock"))
    settings = ServerSettings(
        version=arguments.version,
        claimed_version=arguments.claim_version,
        rate=arguments.rate,
        command_port=arguments.command_port,
        data_port=arguments.data_port,
        multicast_address=arguments.multicast,
        clock_drift_ppm=arguments.drift_ppm,
        latency=arguments.latency_ms / 1e3,
        jitter=arguments.jitter_ms / 1e3,
        restart_period=arguments.restart_every,
        down_time=arguments.down_for,
        seed=arguments.seed,
    )
    return NatNetServer(TrackedScene(names, faults, seed=arguments.seed), settings)


if __name__ == "__main__":
    raise SystemExit(main())
