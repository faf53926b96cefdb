"""Mutated NatNet packets against the client's session: nothing may raise, memory must stay flat.

    tools/env python bench/fuzz_natnet.py --packets 1000000 --seed 1

Packets of every kind and version are cut, lengthened and overwritten with random and with extreme numbers, in
the midst of a conversation that otherwise goes well. Ends with 1 where an exception escaped or memory grew by
more than 16 MiB.
"""

import argparse
import contextlib
import random
import resource
import struct
import sys
import time
import traceback
from collections.abc import Sequence

from knee_gap_perception.trackers.natnet import packets as natnet_packets
from knee_gap_perception.trackers.natnet.buffer import PacketError
from knee_gap_perception.trackers.natnet.session import NatNetSession
from knee_gap_simulation.natnet import packets

SERVER = ("127.0.0.1", 1510)
VERSION = (4, 1)
EXTREMES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
MOST_GROWTH_MIB = 16.0


def seeds() -> list[bytes]:
    """Well-formed packets of every kind and version."""
    body = packets.BodyInFrame(1, (0.1, 1.2, 0.3), (0.0, 0.0, 0.0, 1.0), 2e-4)
    marker = packets.LabeledMarker((1 << 16) + 1, (0.1, 0.2, 0.3), 0.012, 2, 1e-4)
    content = packets.FrameContent(
        number=77,
        bodies=[body, body],
        marker_sets=[("scope", [(0.1, 0.2, 0.3)] * 4), ("all", [])],
        other_markers=[(1.0, 2.0, 3.0)] * 3,
        skeletons=[(9, [body])],
        labeled_markers=[marker] * 4,
        force_plates=[(3, [[1.0, 2.0], [3.0]])],
        devices=[(4, [[1.0], []])],
        mid_exposure_ticks=1000,
        transmit_ticks=2000,
    )
    models = packets.Models(
        bodies=[packets.BodyModel(1, "scope", ((0.0, 0.1, 0.2),) * 4)],
        marker_sets=[("scope", ["a", "b"])],
        force_plates=[(3, "AMTI")],
        cameras=["camera 1"],
    )
    found = [packets.echo_response(bytes(8), 12345), packets.packet(100, b"")]
    for version in packets.VERSIONS:
        found.append(packets.frame(version, content))
        found.append(packets.model_definitions(version, models))
        found.append(
            packets.server_info(
                version, frequency=10_000_000, data_port=1511, multicast_address="239.255.42.99"
            )
        )
    found.append(packets.packet(1, b"Motive".ljust(256, b"\0") + bytes([1, 5, 0, 0, 2, 7, 0, 0])))
    return found


def mutated(data: bytes, rng: random.Random) -> bytes:
    """A damaged copy; half of the time its stated length is made right, so that it gets further."""
    result = bytearray(data)
    for _ in range(rng.choice((0, 1, 1, 2, 4, 16))):
        kind = rng.randrange(4)
        at = rng.randrange(len(result)) if result else 0
        if kind == 0:
            del result[at:]
        elif kind == 1 and len(result) >= at + 4:
            struct.pack_into("<I", result, at, rng.choice(EXTREMES))
        elif kind == 2:
            result[at:at] = rng.randbytes(rng.randrange(1, 9))
        elif result:
            result[at] = rng.randrange(256)
    if len(result) >= 4 and rng.random() < 0.5:
        struct.pack_into("<H", result, 2, (len(result) - 4) & 0xFFFF)
    return bytes(result)


def answered(request: bytes, now: int) -> bytes | None:
    """What a sound server of version 4.1, whose clock is ours, answers to a request."""
    message = struct.unpack_from("<H", request)[0]
    if message == packets.CONNECT:
        return packets.server_info(VERSION, frequency=10**9, data_port=1511, multicast_address=None)
    if message == packets.REQUEST_MODELS:
        return packets.model_definitions(VERSION, packets.Models(bodies=[packets.BodyModel(1, "scope")]))
    if message == packets.ECHO_REQUEST:
        return packets.echo_response(request[4:], now)
    return None


def frame_at(now: int) -> packets.FrameContent:
    """A sound frame that was exposed just before."""
    body = packets.BodyInFrame(1, (0.1, 1.2, 0.3), (0.0, 0.0, 0.0, 1.0), 2e-4)
    return packets.FrameContent(number=now // 1_000_000, bodies=[body], mid_exposure_ticks=now - 1_000_000)


def memory_mib() -> float:
    """Largest resident memory of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    rng = random.Random(arguments.seed)
    originals, session = seeds(), NatNetSession(SERVER[0])
    # A damaged greeting that reads well makes the session start over: seldom, or nothing else is tested.
    weights = [
        0.02 if struct.unpack_from("<H", data)[0] == packets.SERVER_INFO else 1.0 for data in originals
    ]
    versions = [natnet_packets.NatNetVersion(*version) for version in ((2, 5), (2, 7), *packets.VERSIONS)]
    now, frames, escaped, start_mib, began = 1_000_000_000, 0, 0, 0.0, time.monotonic()
    for index in range(arguments.packets):
        if index == arguments.packets // 10:
            start_mib = memory_mib()
        now += rng.randrange(1, 20_000_000)
        data = mutated(rng.choices(originals, weights)[0], rng)
        try:
            for request in session.outgoing(now):
                if answer := answered(request, now):
                    session.receive(answer, SERVER, now + 100_000)
            frames += session.receive(packets.frame(VERSION, frame_at(now)), SERVER, now) is not None
            session.receive(data, SERVER, now)
            with contextlib.suppress(PacketError):
                natnet_packets.decode_packet(data, rng.choice(versions))
            if index % 1000 == 0:
                session.status(now)
        except Exception:
            escaped += 1
            traceback.print_exc()
            print(f"packet {index}: {data.hex()}", file=sys.stderr)
        if index % 100_000 == 99_999:
            print(f"{index + 1} packets, {escaped} escaped exceptions, {memory_mib():.1f} MiB", flush=True)
    growth, seconds = memory_mib() - start_mib, time.monotonic() - began
    refused = session.counts["malformed packets"]
    print(
        f"{arguments.packets} mutated packets in {seconds:.0f} s: {escaped} escaped exceptions, "
        f"{refused} packets refused, {frames} sound frames between them given, "
        f"memory grew by {growth:.1f} MiB after the first tenth"
    )
    return 1 if escaped or growth > MOST_GROWTH_MIB else 0


if __name__ == "__main__":
    raise SystemExit(main())
