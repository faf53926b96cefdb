"""Packets of NatNet 2.5, 2.7 and 3.0 with what is in them: laid out here by hand, and captured by others.

The layout is that of captured packets, written down value by value and without the simulated server, which is
tested against it.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from recordings import BESIDE, RECORDED

V3_CAPTURES = "optitrack/natnet_v3/*.bin"
V2_CAPTURES = "optitrack/natnet_v2/*.bin"
TRAFFIC = "optitrack/natnet_v3/traffic_first_half.pcapng"

SERVER, CLIENT = "10.0.0.5", "10.0.0.77"
CLOCK_HZ = 3_312_787  # of the performance counter of the machine that sent what was captured
FRAME_NS = 8_333_333
Point = tuple[float, float, float]


@dataclass(frozen=True)
class FrameTruth:
    """What one frame with one tracked body holds; lengths [m], ticks of the server's clock."""

    number: int
    body_id: int
    position: Point
    quaternion_xyzw: tuple[float, float, float, float]
    mean_error: float
    mid_exposure_ticks: int
    transmit_ticks: int


@dataclass(frozen=True)
class Conversation3:
    """One packet of each kind of NatNet 3.0 (Motive 2.1), and what they hold."""

    connect: bytes
    server_info: bytes
    model_definitions: bytes
    frame: bytes
    echo_request: bytes
    echo_response: bytes
    truth: FrameTruth
    body_name: str
    echo_stamp: int
    echo_ticks: int


CAPTURED_TRUTH = FrameTruth(
    number=162734,
    body_id=2,
    position=(0.1744466, 1.4471314, -0.7343040),
    quaternion_xyzw=(-0.0545942, 0.5099482, 0.0437036, -0.8573577),
    mean_error=0.51522e-3,
    mid_exposure_ticks=1416497730518,
    transmit_ticks=1416497748722,
)
MADE_TRUTH = FrameTruth(
    number=71_903,
    body_id=5,
    position=(-0.2103125, 1.0625, 0.4409375),
    quaternion_xyzw=(0.48, -0.36, 0.64, -0.48),
    mean_error=0.3125e-3,
    mid_exposure_ticks=987_654_321_098,
    transmit_ticks=987_654_339_300,
)
MARKERS: tuple[Point, ...] = ((-0.25, 1.0625, 0.5), (-0.1875, 1.125, 0.4375), (-0.2031, 1.0, 0.375))
NAME = "Scope"


def natnet_3(origin: str) -> Conversation3:
    """One packet of each kind of NatNet 3.0."""
    if origin == RECORDED:
        kinds = {
            "connect": "connect",
            "server_info": "serverinfo",
            "model_definitions": "modeldef",
            "frame": "mocapframe",
            "echo_request": "echorequest",
            "echo_response": "echoresponse",
        }
        packets = {
            kind: (BESIDE / f"optitrack/natnet_v3/{name}_packet_v3.bin").read_bytes()
            for kind, name in kinds.items()
        }
        return Conversation3(
            **packets,
            truth=CAPTURED_TRUTH,
            body_name="RaceQuad",
            echo_stamp=278554190,
            echo_ticks=1416498545924,
        )
    stamp, ticks = 90_210_044, 987_654_999_123
    return Conversation3(
        connect=_packet(0, b"NatNetLib".ljust(256, b"\0") + bytes([3, 0, 0, 0, 3, 0, 0, 0])),
        server_info=server_info_3(),
        model_definitions=model_definitions_3(),
        frame=frame_3(MADE_TRUTH),
        echo_request=_packet(12, struct.pack("<Q", stamp)),
        echo_response=_packet(13, struct.pack("<QQ", stamp, ticks)),
        truth=MADE_TRUTH,
        body_name=NAME,
        echo_stamp=stamp,
        echo_ticks=ticks,
    )


def server_info_3() -> bytes:
    """Motive 2.1 and NatNet 3.0, multicast to 239.255.42.99:1511."""
    # Motive does not clear its buffer: behind the end of its name stands what was there before.
    name = b"Motive\0" + bytes((7 * k) % 251 + 1 for k in range(249))
    versions = bytes([2, 1, 0, 0]) + bytes([3, 0, 0, 0])
    clock = struct.pack("<Q", CLOCK_HZ)
    way = struct.pack("<H", 1511) + bytes([1]) + bytes([239, 255, 42, 99])
    return _packet(1, name + versions + clock + way)


def model_definitions_3() -> bytes:
    """One rigid body of three markers between its marker set and that of all markers."""
    body = NAME.encode() + b"\0" + struct.pack("<i", MADE_TRUTH.body_id) + struct.pack("<i", -1)
    body += struct.pack("<3f", 0.0, 0.0, 0.0)
    body += struct.pack("<I", 3) + struct.pack("<9f", 0.05, 0.01, 0.0, -0.05, 0.0, 0.02, 0.0, -0.01, -0.06)
    body += struct.pack("<3I", 0, 0, 0)
    own = NAME.encode() + b"\0" + struct.pack("<I", 3) + b"Marker1\0Marker2\0Marker3\0"
    every = b"all\0" + struct.pack("<I", 3) + b"Scope_1\0Scope_2\0Scope_3\0"
    models = struct.pack("<I", 1) + body + struct.pack("<I", 0) + own + struct.pack("<I", 0) + every
    return _packet(5, struct.pack("<I", 3) + models)


def frame_3(truth: FrameTruth) -> bytes:
    """A frame of NatNet 3.0: one body, its labelled markers and one that belongs to nothing."""
    data = struct.pack("<I", truth.number)
    data += struct.pack("<I", 0)  # marker sets
    data += struct.pack("<I", 2) + _points(MARKERS[:2])  # unidentified markers
    data += struct.pack("<I", 1)
    data += struct.pack("<I3f4f", truth.body_id, *truth.position, *truth.quaternion_xyzw)
    data += struct.pack("<fH", truth.mean_error, 1)  # tracked
    data += struct.pack("<I", 0)  # skeletons
    data += struct.pack("<I", 4)
    for index, marker in enumerate(MARKERS, start=1):
        # Marker number in the low half of the id, body in the high one; size, flags, residual.
        data += struct.pack("<HH3ffHf", index, truth.body_id, *marker, 0.0205, 10, 4e-4)
    data += struct.pack("<I3ffHf", 50_007, 0.125, 1.5, -0.25, 0.014, 18, 6e-4)
    data += struct.pack("<II", 0, 0)  # force plates, devices
    data += struct.pack("<II", 0, 0)  # time code and its fraction
    data += struct.pack("<d", truth.number / 120.0)
    data += struct.pack("<QQQ", truth.mid_exposure_ticks, truth.transmit_ticks - 4_000, truth.transmit_ticks)
    data += struct.pack("<H", 0)  # flags
    return _packet(7, data + struct.pack("<I", 0))


def natnet_2(origin: str, motive: str) -> tuple[bytes, bytes, bytes]:
    """What a server of NatNet 2.5 (Motive 1.5.0) or 2.7 (1.7.2) reports, and two frames in a row."""
    if origin == RECORDED:
        folder = BESIDE / "optitrack/natnet_v2"
        first, second, third = (
            (folder / f"frame-motive-{motive}-00{index}.bin").read_bytes() for index in range(3)
        )
        return first, second, third
    version = {"1.5.0": (2, 5), "1.7.2": (2, 7)}[motive]
    # A version that it does not know itself by name: the library's.
    info = _packet(1, b"NatNetLib".ljust(256, b"\0") + bytes([*version, 0, 0]) * 2)
    return info, frame_2(version, 4_100), frame_2(version, 4_101)


def frame_2(version: tuple[int, int], number: int) -> bytes:
    """A frame of NatNet 2.5 or 2.7 of one body at rest, with what those versions still repeat per marker."""
    flagged = version >= (2, 6)
    data = struct.pack("<I", number)
    data += struct.pack("<I", 2)
    for name in (b"Rigid Body 1\0", b"all\0"):
        data += name + struct.pack("<I", 3) + _points(MARKERS)
    data += struct.pack("<I", 1) + _points([(0.5, 0.25, -1.0)])
    data += struct.pack("<I", 1)
    data += struct.pack("<I3f4f", 1, -0.2135, 1.0625 + 1e-5 * (number % 2), 0.4375, 0.6, 0.0, -0.8, 0.0)
    data += struct.pack("<I", 3) + _points(MARKERS) + struct.pack("<3I", 1, 2, 3)
    data += struct.pack("<3f", 0.024, 0.024, 0.024)
    data += struct.pack("<f", 2e-5)
    if flagged:
        data += struct.pack("<H", 1)
    data += struct.pack("<I", 0)  # skeletons
    data += struct.pack("<I", 3)
    for index, marker in enumerate(MARKERS, start=1):
        data += struct.pack("<I3ff", index, *marker, 0.024)
        if flagged:
            data += struct.pack("<H", 2)
    data += struct.pack("<f", 3_426.8)  # latency
    data += struct.pack("<II", 0, 0)  # time code and its fraction
    if flagged:
        data += struct.pack("<d", number / 100.0) + struct.pack("<H", 0)
    return _packet(7, data + struct.pack("<I", 0))


@dataclass(frozen=True)
class Traffic:
    """A conversation of a server with somebody's client, as a pcapng file of Ethernet frames."""

    capture: bytes
    server: str
    names: dict[int, str]


def traffic(origin: str) -> Traffic:
    """A second and a half of a server at 120 Hz, greeted, asked for its models, and echoed."""
    if origin == RECORDED:
        return Traffic((BESIDE / TRAFFIC).read_bytes(), "192.168.0.106", {2: "RaceQuad"})
    packets: list[tuple[int, str, int, bytes]] = []
    begin_ns = 1_560_000_000_000_000_000

    def ticks(now_ns: int) -> int:
        return 987_000_000_000 + (now_ns - begin_ns) * CLOCK_HZ // 1_000_000_000

    def exchange(now_ns: int, request: bytes, answer: bytes) -> None:
        packets.append((now_ns, CLIENT, 51_001, request))
        packets.append((now_ns + 350_000, SERVER, 1510, answer))

    exchange(begin_ns, natnet_3("made").connect, server_info_3())
    exchange(begin_ns + 2_000_000, _packet(4, b""), model_definitions_3())
    for k in range(15):
        sent_ns = begin_ns + 5_000_000 + 100_000_000 * k
        stamp = struct.pack("<Q", sent_ns // 100)
        # The server reads its clock in the middle of the echo's way.
        answer = _packet(13, stamp + struct.pack("<Q", ticks(sent_ns + 175_000)))
        exchange(sent_ns, _packet(12, stamp), answer)
    for k in range(180):
        exposed_ns = begin_ns + FRAME_NS * k
        truth = FrameTruth(
            number=5_000 + k,
            body_id=MADE_TRUTH.body_id,
            position=(0.001 * k, 1.0, 0.5),
            quaternion_xyzw=MADE_TRUTH.quaternion_xyzw,
            mean_error=3e-4,
            mid_exposure_ticks=ticks(exposed_ns),
            transmit_ticks=ticks(exposed_ns + 5_500_000),
        )
        packets.append((exposed_ns + 6_000_000, SERVER, 1511, frame_3(truth)))
    packets.sort(key=lambda item: item[0])
    return Traffic(_pcapng(packets), SERVER, {MADE_TRUTH.body_id: NAME})


def _packet(message: int, payload: bytes) -> bytes:
    return struct.pack("<HH", message, len(payload)) + payload


def _points(points: Sequence[Point]) -> bytes:
    return b"".join(struct.pack("<3f", *point) for point in points)


def _pcapng(packets: Sequence[tuple[int, str, int, bytes]]) -> bytes:
    """UDP packets (time [ns], sender, port, payload) in Ethernet frames, timed to a microsecond."""

    def block(kind: int, body: bytes) -> bytes:
        padded = body + bytes(-len(body) % 4)
        length = len(padded) + 12
        return struct.pack("<II", kind, length) + padded + struct.pack("<I", length)

    # Section header of version 1.0 and unknown length; one interface of Ethernet.
    capture = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    capture += block(1, struct.pack("<HHI", 1, 0, 65535))
    for time_ns, sender, port, payload in packets:
        receiver = CLIENT if sender == SERVER else SERVER
        addresses = b"".join(bytes(int(part) for part in host.split(".")) for host in (sender, receiver))
        udp = struct.pack(">HHHH", port, 1510, 8 + len(payload), 0) + payload
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + addresses + udp
        ethernet = bytes(12) + b"\x08\x00" + ip
        high, low = divmod(time_ns // 1000, 1 << 32)
        head = struct.pack("<IIIII", 0, high, low, len(ethernet), len(ethernet))
        capture += block(6, head + ethernet)
    return capture
