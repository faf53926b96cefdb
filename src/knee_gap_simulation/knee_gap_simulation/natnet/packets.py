"""Encoding of NatNet packets as Motive sends them: versions 3.0, 3.1, 4.0 and 4.1, little-endian.

A packet is a message number (uint16), the length of its payload (uint16) and the payload. Texts end with a
zero byte; every list starts with its length (uint32), and from 4.1 on with its size in bytes too (uint32).
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from knee_gap_simulation.errors import SimulationError

Version = tuple[int, int]
Point = tuple[float, ...]

VERSIONS: tuple[Version, ...] = ((3, 0), (3, 1), (4, 0), (4, 1))

CONNECT, SERVER_INFO, REQUEST, RESPONSE, REQUEST_MODELS, MODELS = 0, 1, 2, 3, 4, 5
FRAME, DISCONNECT, KEEP_ALIVE, ECHO_REQUEST, ECHO_RESPONSE, DISCOVERY = 7, 9, 10, 12, 13, 14
UNRECOGNIZED_REQUEST = 100

TRACKING_VALID = 1
MODELS_CHANGED = 2


@dataclass(frozen=True)
class BodyInFrame:
    """One rigid body in a frame: position [m], quaternion x y z w, mean residual of its markers [m]."""

    id: int
    position: Point
    quaternion_xyzw: Point
    mean_error: float = 0.0
    tracking_valid: bool = True


@dataclass(frozen=True)
class LabeledMarker:
    """One marker of a model; the halves of its id are the model's and the marker's number."""

    id: int
    position: Point
    size: float
    flags: int
    residual: float


@dataclass(frozen=True)
class FrameContent:
    """Content of one frame of data; ticks of the server's clock. Assets (from 4.1 on) stay empty."""

    number: int
    bodies: Sequence[BodyInFrame] = ()
    marker_sets: Sequence[tuple[str, Sequence[Point]]] = ()
    other_markers: Sequence[Point] = ()
    skeletons: Sequence[tuple[int, Sequence[BodyInFrame]]] = ()
    labeled_markers: Sequence[LabeledMarker] = ()
    force_plates: Sequence[tuple[int, Sequence[Sequence[float]]]] = ()
    devices: Sequence[tuple[int, Sequence[Sequence[float]]]] = ()
    timecode: int = 0
    timecode_subframe: int = 0
    timestamp: float = 0.0
    mid_exposure_ticks: int = 0
    received_ticks: int = 0
    transmit_ticks: int = 0
    flags: int = 0


@dataclass(frozen=True)
class BodyModel:
    """Definition of one rigid body: markers [m] in the body's frame."""

    id: int
    name: str
    markers: Sequence[Point] = ()
    parent_id: int = -1
    offset: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Models:
    """Definitions of all models in the stream; marker sets are names and their markers' names."""

    bodies: Sequence[BodyModel] = ()
    marker_sets: Sequence[tuple[str, Sequence[str]]] = ()
    force_plates: Sequence[tuple[int, str]] = field(default=())
    cameras: Sequence[str] = ()


def packet(message: int, payload: bytes) -> bytes:
    """Packet of a payload and its header. Raises SimulationError if the payload is too long."""
    if len(payload) > 0xFFFF:
        raise SimulationError(f"a NatNet packet holds at most 65535 bytes, not {len(payload)}")
    return struct.pack("<HH", message, len(payload)) + payload


def server_info(
    version: Version,
    *,
    frequency: int,
    data_port: int,
    multicast_address: str | None,
    motive: Version = (3, 1),
) -> bytes:
    """Server description; `multicast_address` None means unicast."""
    group = (multicast_address or "239.255.42.99").split(".")
    return packet(
        SERVER_INFO,
        b"Motive".ljust(256, b"\0")
        + bytes([*motive, 0, 0, *version, 0, 0])
        + struct.pack("<QHB", frequency, data_port, multicast_address is not None)
        + bytes(int(number) for number in group),
    )


def echo_response(request_stamp: bytes, ticks: int) -> bytes:
    """Echo response: the client's stamp as received and the server's ticks at that time."""
    return packet(ECHO_RESPONSE, request_stamp + struct.pack("<Q", ticks))


def frame(version: Version, content: FrameContent) -> bytes:
    """One frame of data."""
    parts: list[list[bytes]] = [
        [_text(name) + _list(_point(point) for point in points) for name, points in content.marker_sets],
        [_point(point) for point in content.other_markers],
        [_body(body) for body in content.bodies],
        [
            struct.pack("<I", number) + _list(_body(body) for body in bodies)
            for number, bodies in content.skeletons
        ],
        [],  # assets
        [_labeled_marker(marker) for marker in content.labeled_markers],
        [_channels(*device) for device in content.force_plates],
        [_channels(*device) for device in content.devices],
    ]
    if version < (4, 1):
        del parts[4]
    end = struct.pack("<IId", content.timecode, content.timecode_subframe, content.timestamp)
    end += struct.pack("<QQQ", content.mid_exposure_ticks, content.received_ticks, content.transmit_ticks)
    if version >= (4, 1):
        end += struct.pack("<II", 0, 0)  # time of day by a hardware clock: there is none
    end += struct.pack("<HI", content.flags, 0)  # flags, end mark
    return packet(
        FRAME,
        struct.pack("<I", content.number) + b"".join(_sized_list(version, part) for part in parts) + end,
    )


def model_definitions(version: Version, models: Models) -> bytes:
    """Model definitions: names and shapes of the bodies in the frames."""
    sets = [(0, _text(name) + _list(map(_text, markers))) for name, markers in models.marker_sets]
    bodies = [(1, _body_model(version, body)) for body in models.bodies]
    plates = [(3, _force_plate(number, serial)) for number, serial in models.force_plates]
    cameras = [(5, _text(name) + struct.pack("<7f", 0, 0, 0, 0, 0, 0, 1)) for name in models.cameras]
    payload = b""
    described = [*sets, *bodies, *plates, *cameras]
    for kind, data in described:
        size = struct.pack("<I", len(data)) if version >= (4, 1) else b""
        payload += struct.pack("<I", kind) + size + data
    return packet(MODELS, struct.pack("<I", len(described)) + payload)


def _text(text: str) -> bytes:
    return text.encode("utf-8") + b"\0"


def _point(point: Point) -> bytes:
    return struct.pack("<3f", *point)


def _list(items: Iterable[bytes]) -> bytes:
    listed = list(items)
    return struct.pack("<I", len(listed)) + b"".join(listed)


def _sized_list(version: Version, items: list[bytes]) -> bytes:
    data = b"".join(items)
    size = struct.pack("<I", len(data)) if version >= (4, 1) else b""
    return struct.pack("<I", len(items)) + size + data


def _body(body: BodyInFrame) -> bytes:
    return struct.pack(
        "<I3f4ffH",
        body.id,
        *body.position,
        *body.quaternion_xyzw,
        body.mean_error,
        TRACKING_VALID if body.tracking_valid else 0,
    )


def _labeled_marker(marker: LabeledMarker) -> bytes:
    return struct.pack("<I3ffHf", marker.id, *marker.position, marker.size, marker.flags, marker.residual)


def _channels(number: int, channels: Sequence[Sequence[float]]) -> bytes:
    values = (_list(struct.pack("<f", value) for value in channel) for channel in channels)
    return struct.pack("<I", number) + _list(values)


def _body_model(version: Version, body: BodyModel) -> bytes:
    data = _text(body.name) + struct.pack("<ii3f", body.id, body.parent_id, *body.offset)
    data += _list(_point(marker) for marker in body.markers)
    data += struct.pack(f"<{len(body.markers)}I", *[0] * len(body.markers))  # no active markers
    if version >= (4, 0):
        data += b"".join(_text(f"Marker{index + 1}") for index in range(len(body.markers)))
    return data


def _force_plate(number: int, serial: str) -> bytes:
    size, origin, corners = (0.6, 0.4), (0.0, 0.0, 0.0), (0.3, 0.0, 0.2) * 4
    identity = [float(row == column) for row in range(12) for column in range(12)]
    data = struct.pack("<I", number) + _text(serial)
    data += struct.pack("<161f", *size, *origin, *identity, *corners)
    return data + struct.pack("<II", 1, 0) + _list(_text(f"Fz{index}") for index in range(2))
