"""NatNet client over UDP: sockets and clocks around a session."""

import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.parameters import check_parameters
from knee_gap_perception.trackers.body_source import BodyFrame, SourceStatus
from knee_gap_perception.trackers.natnet.session import NatNetSession

MAX_PACKET_BYTES = 65_536
# Most packets read in one call, so that a flood does not block the caller.
MAX_PACKETS = 512
RECEIVE_BUFFER_BYTES = 1 << 20
# Interval between two checks for requests to be sent [s].
STEP = 0.01


@dataclass(frozen=True)
class NatNetParameters:
    """Address and transmission of Motive. Raises PerceptionError for values outside their range."""

    server_address: str = field(
        default="127.0.0.1", metadata={"description": "Address of the machine that runs Motive"}
    )
    local_address: str = field(
        default="",
        metadata={"description": "Address of this machine's interface to Motive; empty: automatic"},
    )
    command_port: int = field(
        default=1510, metadata={"description": "UDP port of Motive for commands", "range": (1, 65535)}
    )
    transmission: str = field(
        default="auto",
        metadata={
            "description": "Transmission of Motive; auto asks the server (NatNet 3.0 and later)",
            "choices": ("auto", "unicast", "multicast"),
        },
    )
    multicast_address: str = field(
        default="239.255.42.99",
        metadata={"description": "Multicast group of the data, as set in Motive; no other is joined"},
    )
    data_port: int = field(
        default=1511,
        metadata={
            "description": "UDP port of multicast data, as set in Motive",
            "range": (1, 65535),
        },
    )
    max_clock_error: float = field(
        default=0.001,
        metadata={
            "description": "Largest error bound of the time of exposure, half of an echo's duration [s]; "
            "frames are not used until it is reached",
            "range": (1e-5, 0.1),
        },
    )

    def __post_init__(self) -> None:
        check_parameters(self)


class NatNetClient:
    """Receives frames from Motive; a `BodySource`. It never blocks longer than the given timeout.

    One thread may poll while another asks for the status.

    `ros_now` gives the ROS time [ns]; stamps follow its steps. `up_axis` is that of Motive's stream. Raises
    PerceptionError for an invalid address or one that this machine does not have.
    """

    waits = True
    subscriptions = ()

    def __init__(
        self,
        parameters: NatNetParameters | None = None,
        ros_now: Callable[[], int] = time.time_ns,
        *,
        up_axis: str = "y",
    ) -> None:
        self.parameters = parameters or NatNetParameters()
        self._ros_now = ros_now
        server = _resolved(self.parameters.server_address)
        self._server = (server, self.parameters.command_port)
        # The addresses to receive from are never taken from a packet.
        self._group = (self.parameters.multicast_address, self.parameters.data_port)
        self.session = NatNetSession(
            server,
            command_port=self.parameters.command_port,
            group=f"{self._group[0]}:{self._group[1]}",
            up_axis=up_axis,
            max_clock_error=self.parameters.max_clock_error,
        )
        self._local = self.parameters.local_address or _route_to(self._server)
        self._command = _udp_socket((self._local, 0))
        self._data: socket.socket | None = None
        self._joined = False
        self._send_fault = ""
        # One thread receives, another asks for the status.
        self._lock = threading.Lock()
        if self.parameters.transmission == "multicast":
            self._join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self, timeout: float = 0.0) -> list[BodyFrame]:
        """Return the frames received since the last call; wait up to `timeout` [s] for the first."""
        end = time.monotonic() + timeout
        # Waiting packets are read first: after a pause of this process, the server must not count as lost.
        frames = self._receive(0.0)
        while True:
            self._send_due()
            left = end - time.monotonic()
            if frames or left <= 0.0:
                return frames
            frames = self._receive(min(left, STEP))

    def status(self) -> SourceStatus:
        """Return the status of the connection."""
        with self._lock:
            status = self.session.status(time.monotonic_ns())
        if self._send_fault and not status.ok:
            return SourceStatus(False, f"{status.words}; sending fails: {self._send_fault}", status.values)
        return status

    def close(self) -> None:
        """Close the sockets."""
        self._command.close()
        if self._data is not None:
            self._data.close()

    def _send_due(self) -> None:
        with self._lock:
            requests = self.session.outgoing(time.monotonic_ns())
        for request in requests:
            try:
                self._command.sendto(request, self._server)
                self._send_fault = ""
            except OSError as error:
                # The network may come back; until then the status reports it.
                self._send_fault = error.strerror or str(error)

    def _receive(self, timeout: float) -> list[BodyFrame]:
        sockets = [self._command] if self._data is None else [self._command, self._data]
        readable, _, _ = select.select(sockets, [], [], timeout)
        frames = []
        for ready in readable:
            for _ in range(MAX_PACKETS):
                try:
                    data, sender = ready.recvfrom(MAX_PACKET_BYTES)
                except BlockingIOError:
                    break
                except OSError:
                    # On Linux a request to a closed port fails the next read; the session retries.
                    continue
                arrival_ns = time.monotonic_ns()
                offset_ns = self._ros_offset_ns()
                with self._lock:
                    frame = self.session.receive(data, sender, arrival_ns, offset_ns)
                if frame is not None:
                    frames.append(frame)
        self._follow_transmission()
        return frames

    def _ros_offset_ns(self) -> int:
        """ROS time minus monotonic time, by the fastest of several readings."""
        readings = []
        for _ in range(3):
            before = time.monotonic_ns()
            ros = self._ros_now()
            after = time.monotonic_ns()
            readings.append((after - before, ros - (before + after) // 2))
        return min(readings)[1]

    def _follow_transmission(self) -> None:
        """Join the configured multicast group, if the server sends by multicast or its way is unknown."""
        info = self.session.info
        if self.parameters.transmission == "auto" and info is not None and info.multicast is not False:
            self._join()

    def _join(self) -> None:
        if self._joined:
            return
        self._joined = True
        try:
            self._data = _udp_socket(self._group, shared=True)
            membership = socket.inet_aton(self._group[0]) + socket.inet_aton(self._local)
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except (OSError, PerceptionError) as error:
            group = f"{self._group[0]}:{self._group[1]}"
            self._send_fault = f"multicast {group} cannot be joined: {error}"


def _resolved(address: str) -> str:
    try:
        return socket.gethostbyname(address)
    except OSError:
        raise PerceptionError(f"server_address '{address}' cannot be resolved") from None


def _route_to(server: tuple[str, int]) -> str:
    """Address of the interface used for packets to the server."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(server)
        except OSError:
            return "0.0.0.0"
        return str(probe.getsockname()[0])


def _udp_socket(address: tuple[str, int], *, shared: bool = False) -> socket.socket:
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.setblocking(False)
        result.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if shared:
            result.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        result.bind(address)
    except OSError as error:
        result.close()
        reason = error.strerror or str(error)
        raise PerceptionError(f"this machine has no interface {address[0]}:{address[1]} ({reason})") from None
    return result
