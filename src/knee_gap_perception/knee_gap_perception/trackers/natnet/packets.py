"""Decoding and encoding of NatNet packets: pure functions without sockets and clocks.

A packet is a message number (uint16), the length of its payload (uint16) and the payload, little-endian.
Positions are metres in Motive's axes (Y up unless set otherwise), quaternions x y z w. Versions 2.x, 3.x and
4.x are decoded. Their layouts differ, so the server's version must be known first. The elements of frames and
of model definitions are decoded by the message classes of the `natnet` package, except where those are wrong:
the last part of a frame (2.x and 4.1), the server's clock, and force plates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from math import isfinite
from typing import Any, NamedTuple

from natnet import data_descriptions, data_frame
from natnet.version import Version

from knee_gap_perception.trackers.natnet.buffer import BoundedBuffer, PacketError

HEADER_BYTES = 4
MAX_MODELS = 4096


class MessageId(IntEnum):
    """Message numbers of NatNet."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODEL_DEFINITIONS = 4
    MODEL_DEFINITIONS = 5
    REQUEST_FRAME = 6
    FRAME = 7
    TEXT = 8
    DISCONNECT = 9
    KEEP_ALIVE = 10
    ECHO_REQUEST = 12
    ECHO_RESPONSE = 13
    DISCOVERY = 14
    UNRECOGNIZED_REQUEST = 100


class NatNetVersion(NamedTuple):
    """Version of the protocol, such as `3.0`."""

    major: int
    minor: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}"


@dataclass(frozen=True)
class ServerInfo:
    """Description of a server.

    `clock_frequency` is that of its time stamps [Hz]. It, the data port and the way of transmission are None
    before NatNet 3.0.
    """

    application: str
    application_version: str
    natnet_version: NatNetVersion
    clock_frequency: int | None = None
    data_port: int | None = None
    multicast: bool | None = None
    multicast_address: str | None = None


@dataclass(frozen=True)
class ModelDefinitions:
    """Names of the rigid bodies by their streaming id."""

    bodies: dict[int, str]


@dataclass(frozen=True)
class RigidBody:
    """One body of a frame; `tracking_valid` is None if the version does not have it (before 2.6)."""

    id: int
    position: tuple[float, ...]
    quaternion_xyzw: tuple[float, ...]
    mean_error: float
    tracking_valid: bool | None


@dataclass(frozen=True)
class Frame:
    """One frame; the server's ticks of exposure and of sending are None before 3.0 and if they are 0."""

    number: int
    bodies: tuple[RigidBody, ...]
    mid_exposure_ticks: int | None
    transmit_ticks: int | None
    models_changed: bool


@dataclass(frozen=True)
class EchoResponse:
    """Echo response: the client's own stamp, and the server's ticks when it was received."""

    request_stamp: int
    server_ticks: int


@dataclass(frozen=True)
class Unrecognized:
    """Response to a request that the server does not know."""


Packet = ServerInfo | ModelDefinitions | Frame | EchoResponse | Unrecognized


def decode_packet(data: bytes, version: NatNetVersion | None) -> Packet | None:
    """Return the content of a packet, or None for messages that are not needed here.

    `version` is the server's, from its ServerInfo; without it, frames and model definitions are refused.
    Raises PacketError, and nothing else, for any data that are not a packet of that version.
    """
    if len(data) < HEADER_BYTES:
        raise PacketError(f"a packet has at least {HEADER_BYTES} bytes, not {len(data)}")
    buffer = BoundedBuffer(data)
    message, length = buffer.read("HH")
    if length != buffer.remaining:
        raise PacketError(f"the packet announces {length} bytes, but contains {buffer.remaining}")
    if message == MessageId.SERVER_INFO:
        return _server_info(buffer)
    if message == MessageId.ECHO_RESPONSE:
        return EchoResponse(*buffer.read("QQ"))
    if message == MessageId.UNRECOGNIZED_REQUEST:
        return Unrecognized()
    if message not in (MessageId.FRAME, MessageId.MODEL_DEFINITIONS):
        return None
    if version is None:
        raise PacketError("data were received before the server's version")
    if not 2 <= version.major <= 4:
        raise PacketError(
            f"the server uses NatNet {version}; 2.x to 4.x are supported (choose the bitstream in Motive)"
        )
    return _frame(buffer, version) if message == MessageId.FRAME else _model_definitions(buffer, version)


def encode_request(message: MessageId, payload: bytes = b"") -> bytes:
    """Bytes of a request to the server."""
    return int(message).to_bytes(2, "little") + len(payload).to_bytes(2, "little") + payload


def connect_request() -> bytes:
    """Connection request: every version answers it with a ServerInfo, and a unicast server starts to send.

    The payload is the sender's name (256 bytes), its version and its NatNet version (4 bytes each), and, from
    4.0 on, whether a subset (no) or another version (none) is requested.
    """
    sender = b"knee_gap".ljust(256, b"\0") + bytes([1, 0, 0, 0]) + bytes([4, 1, 0, 0])
    return encode_request(MessageId.CONNECT, sender + bytes(5))


def echo_request(stamp: int) -> bytes:
    """Echo request, which the server returns with the ticks of its clock."""
    return encode_request(MessageId.ECHO_REQUEST, stamp.to_bytes(8, "little"))


def _server_info(buffer: BoundedBuffer) -> ServerInfo:
    application = buffer.read_string(256, static_length=True)
    application_version = ".".join(str(number) for number in buffer.read("4B")).removesuffix(".0.0")
    major, minor, *_ = buffer.read("4B")
    version = NatNetVersion(major, minor)
    if version < (3, 0):
        return ServerInfo(application, application_version, version)
    frequency, port, multicast = buffer.read("QHB")
    if frequency == 0:
        raise PacketError("the server's clock frequency is 0 Hz")
    group = ".".join(str(number) for number in buffer.read("4B"))
    return ServerInfo(application, application_version, version, frequency, port, bool(multicast), group)


def _sized(version: NatNetVersion) -> bool:
    """Whether each part of a packet contains its length in bytes."""
    return version >= (4, 1)


def _frame(buffer: BoundedBuffer, version: NatNetVersion) -> Frame:
    number = buffer.read_uint32()
    bodies: tuple[RigidBody, ...] = ()
    for read, since in _FRAME_PARTS:
        if version < since:
            continue
        count = buffer.read_uint32()
        size = buffer.read_uint32() if _sized(version) else None
        end = None if size is None else buffer.pointer + size
        if read is _rigid_body:
            bodies = tuple(_rigid_body(buffer, version) for _ in range(count))
            if end is not None and buffer.pointer != end:
                raise PacketError(f"a rigid body of NatNet {version} does not have the size known from 4.1")
        elif size is not None:
            buffer.skip(size)
        else:
            for _ in range(count):
                read(buffer, version)
    mid_exposure, transmit, parameters = _frame_end(buffer, version)
    return Frame(number, bodies, mid_exposure or None, transmit or None, bool(parameters & 2))


def _frame_end(buffer: BoundedBuffer, version: NatNetVersion) -> tuple[int, int, int]:
    """Ticks of mid-exposure and of sending, and the flags, from the bytes after the data of a frame.

    An end mark of 4 bytes follows the flags, or nothing; some servers of 4.0 send a hardware clock's time as
    well. Any other length is not a frame of this version.
    """
    if version < (3, 0):
        # Latency, timecode, and a time of the server that cannot be related to a clock here.
        if not 12 <= buffer.remaining <= 26:
            raise PacketError(f"{buffer.remaining} bytes end a frame that is not of NatNet {version}")
        return 0, 0, 0
    buffer.skip(4 + 4 + 8)  # timecode, its subframe, time since the start
    mid_exposure, _, transmit = buffer.read("QQQ")
    if buffer.remaining in (10, 14):
        buffer.skip(8)  # time of day by a hardware clock, from 4.1
    if buffer.remaining not in (2, 6):
        raise PacketError(f"{buffer.remaining} bytes end a frame that is not of NatNet {version}")
    return mid_exposure, transmit, buffer.read_uint16()


def _natnet_element(element: Any) -> Callable[[BoundedBuffer, NatNetVersion], Any]:
    def read(buffer: BoundedBuffer, version: NatNetVersion) -> Any:
        return element.read_from_buffer(buffer, Version(*version))

    return read


def _rigid_body(buffer: BoundedBuffer, version: NatNetVersion) -> RigidBody:
    body = data_frame.RigidBody.read_from_buffer(buffer, Version(*version))
    mean_error = body.marker_error if isfinite(body.marker_error) else float("nan")
    return RigidBody(body.id_num, body.pos, body.rot, mean_error, body.tracking_valid)


def _position(buffer: BoundedBuffer, version: NatNetVersion) -> None:
    buffer.skip(12)


_FRAME_PARTS: tuple[tuple[Callable[[BoundedBuffer, NatNetVersion], Any], tuple[int, int]], ...] = (
    (_natnet_element(data_frame.MarkerSet), (0, 0)),
    (_position, (0, 0)),
    (_rigid_body, (0, 0)),
    (_natnet_element(data_frame.Skeleton), (2, 1)),
    (_natnet_element(data_frame.Asset), (4, 1)),
    (_natnet_element(data_frame.LabeledMarker), (2, 3)),
    (_natnet_element(data_frame.ForcePlate), (2, 9)),
    (_natnet_element(data_frame.Device), (2, 11)),
)


def _force_plate(buffer: BoundedBuffer, version: NatNetVersion) -> None:
    buffer.skip(4)
    buffer.read_string()
    # Width and length, position, calibration 12x12, four corners (the natnet package reads three), two types.
    buffer.skip(4 * (2 + 3 + 144 + 12 + 2))
    for _ in range(buffer.read_uint32()):
        buffer.read_string()


_DESCRIPTIONS: dict[int, Callable[[BoundedBuffer, NatNetVersion], Any]] = {
    0: _natnet_element(data_descriptions.MarkerSetDescription),
    1: _natnet_element(data_descriptions.RigidBodyDescription),
    2: _natnet_element(data_descriptions.SkeletonDescription),
    3: _force_plate,
    4: _natnet_element(data_descriptions.DeviceDescription),
    5: _natnet_element(data_descriptions.CameraDescription),
    6: _natnet_element(data_descriptions.AssetDescription),
}
_RIGID_BODY_DESCRIPTION = 1


def _model_definitions(buffer: BoundedBuffer, version: NatNetVersion) -> ModelDefinitions:
    bodies: dict[int, str] = {}
    count = buffer.read_uint32()
    if count > MAX_MODELS:
        raise PacketError(f"the packet announces {count} models, more than {MAX_MODELS}")
    for _ in range(count):
        kind = buffer.read_uint32()
        end = buffer.read_uint32() + buffer.pointer if _sized(version) else None
        if kind == _RIGID_BODY_DESCRIPTION:
            body = _DESCRIPTIONS[kind](buffer, version)
            bodies[body.id_num] = body.name
        elif end is None:
            if kind not in _DESCRIPTIONS:
                raise PacketError(f"a model of the unknown kind {kind}: the rest cannot be read")
            _DESCRIPTIONS[kind](buffer, version)
        if end is not None:
            buffer.skip(end - buffer.pointer)
    return ModelDefinitions(bodies)
