"""A NatNet server on the loopback that behaves like Motive, faults included, for tests without a tracker.

It answers connections, echoes and requests for model definitions, and sends frames by unicast to connected
clients or by multicast. Its clock starts at an arbitrary value, runs at its own rate, and starts again after
each restart.
"""

import heapq
import select
import socket
import struct
import time
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np

from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.natnet import packets
from knee_gap_simulation.natnet.scene import TrackedScene

HOST = "127.0.0.1"
CLIENT_SILENCE_NS = 10 * NANOSECONDS


@dataclass(frozen=True)
class ServerSettings:
    """Settings of the server. Times in seconds, unless the name has another unit.

    `claimed_version` is the version reported to clients, if it is not the version that is sent.
    """

    version: packets.Version = (4, 1)
    claimed_version: packets.Version | None = None
    rate: float = 240.0
    command_port: int = 1510
    data_port: int = 1511
    multicast_address: str | None = None
    clock_frequency: int = 10_000_000
    clock_drift_ppm: float = 40.0
    latency: float = 0.004
    jitter: float = 0.0
    restart_period: float = 0.0
    down_time: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.version not in packets.VERSIONS:
            known = ", ".join(f"{major}.{minor}" for major, minor in packets.VERSIONS)
            raise SimulationError(f"the NatNet version must be one of {known}, not {self.version}")
        if not 1.0 <= self.rate <= 2000.0:
            raise SimulationError(f"the rate must lie in [1, 2000] Hz, not {self.rate}")
        for name in ("command_port", "data_port"):
            if not 1 <= getattr(self, name) <= 65535:
                raise SimulationError(f"{name} must lie in [1, 65535], not {getattr(self, name)}")
        for name in ("latency", "jitter", "restart_period", "down_time"):
            if not 0.0 <= getattr(self, name) < 1e6:
                raise SimulationError(f"{name} must not be negative, not {getattr(self, name)} s")


@dataclass
class ServerCounts:
    """Counts of the server's frames and restarts."""

    frames: int = 0
    restarts: int = 0
    clients: int = 0
    requests: dict[int, int] = field(default_factory=dict)


class NatNetServer:
    """Serves a scene. `step` handles what is due and waits for the next event.

    Raises SimulationError if the port is in use.
    """

    def __init__(self, scene: TrackedScene, settings: ServerSettings | None = None) -> None:
        self.scene = scene
        self.settings = settings or ServerSettings()
        self.counts = ServerCounts()
        self._rng = np.random.default_rng(self.settings.seed)
        self._period_ns = round(NANOSECONDS / self.settings.rate)
        self._command = _bound_socket(self.settings.command_port)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._start(time.monotonic_ns())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._command.close()

    def step(self, longest: float = 0.05) -> None:
        """Answer requests, send due frames, and wait for the next of either for at most `longest` [s]."""
        now = time.monotonic_ns()
        self._restart_if_due(now)
        if now >= self._next_ns and self._up(now):
            self._expose(now)
        self._send_due(now)
        due = min(self._next_ns, self._waiting[0][0] if self._waiting else self._next_ns)
        wait = min(max((due - time.monotonic_ns()) / NANOSECONDS, 0.0), longest)
        while select.select([self._command], [], [], wait)[0]:
            self._answer()
            wait = 0.0

    def ticks(self, monotonic_ns: int) -> int:
        """Ticks of the server's clock at a local time."""
        rate = self.settings.clock_frequency * (1.0 + self.settings.clock_drift_ppm * 1e-6)
        return self._first_tick + round((monotonic_ns - self._started_ns) * rate / NANOSECONDS)

    def _start(self, now: int) -> None:
        self._started_ns = now
        self._first_tick = int(self._rng.integers(10**9, 10**14))
        self._number = int(self._rng.integers(0, 10**6))
        self._next_ns = now
        self._down_until_ns = 0
        self._last_send_ns = 0
        self._clients: dict[tuple[str, int], int] = {}
        self._waiting.clear()

    def _restart_if_due(self, now: int) -> None:
        settings = self.settings
        if self._down_until_ns and now >= self._down_until_ns:
            self._start(now)
            self.counts.restarts += 1
        elif (
            settings.restart_period
            and not self._down_until_ns
            and now - self._started_ns > settings.restart_period * NANOSECONDS
        ):
            self._down_until_ns = now + round(settings.down_time * NANOSECONDS)
            self._clients.clear()
            self._waiting.clear()
            self._next_ns = self._down_until_ns

    def _up(self, now: int) -> bool:
        return now >= self._down_until_ns

    def _expose(self, now: int) -> None:
        """Make the frame whose exposure was due, and queue it for its latency and jitter."""
        settings = self.settings
        exposure_ns = self._next_ns
        self._next_ns += self._period_ns
        if now - self._next_ns > NANOSECONDS:
            # The machine slept: the frames missed meanwhile are not made up for.
            self._next_ns = now
        self._number += 1
        # The scene runs by the time of day, so that another process can compute the truth.
        time_s = (exposure_ns + _time_of_day_offset_ns()) / NANOSECONDS
        bodies = self.scene.bodies(time_s)
        if self.scene.frame_is_lost():
            return
        delay = settings.latency + (self._rng.exponential(settings.jitter) if settings.jitter else 0.0)
        # Motive's queue keeps the order: a late frame delays those behind it.
        send_ns = max(exposure_ns + round(delay * NANOSECONDS), self._last_send_ns)
        self._last_send_ns = send_ns
        content = packets.FrameContent(
            number=self._number,
            bodies=bodies,
            timestamp=(exposure_ns - self._started_ns) / NANOSECONDS,
            mid_exposure_ticks=self.ticks(exposure_ns),
            received_ticks=self.ticks(exposure_ns + round(settings.latency / 2 * NANOSECONDS)),
            transmit_ticks=self.ticks(send_ns),
        )
        heapq.heappush(self._waiting, (send_ns, self._number, packets.frame(settings.version, content)))

    def _send_due(self, now: int) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            _, _, data = heapq.heappop(self._waiting)
            for receiver in self._receivers(now):
                self._command.sendto(data, receiver)
            self.counts.frames += 1

    def _receivers(self, now: int) -> list[tuple[str, int]]:
        if self.settings.multicast_address is not None:
            return [(self.settings.multicast_address, self.settings.data_port)]
        for client, heard_ns in list(self._clients.items()):
            if now - heard_ns > CLIENT_SILENCE_NS:
                del self._clients[client]
        return list(self._clients)

    def _answer(self) -> None:
        try:
            data, sender = self._command.recvfrom(65536)
        except OSError:
            return  # a reply to a client that has disconnected
        now = time.monotonic_ns()
        if not self._up(now) or len(data) < 4:
            return
        message, _ = struct.unpack_from("<HH", data)
        self.counts.requests[message] = self.counts.requests.get(message, 0) + 1
        settings = self.settings
        if message in (packets.CONNECT, packets.DISCOVERY):
            if message == packets.CONNECT:
                self._clients[sender] = now
                self.counts.clients = max(self.counts.clients, len(self._clients))
            self._reply(
                sender,
                packets.server_info(
                    settings.claimed_version or settings.version,
                    frequency=settings.clock_frequency,
                    data_port=settings.data_port,
                    multicast_address=settings.multicast_address,
                ),
            )
        elif sender not in self._clients:
            return
        elif message == packets.REQUEST_MODELS:
            models = packets.Models(bodies=self.scene.models(), marker_sets=[("all", ["Marker1"])])
            self._reply(sender, packets.model_definitions(settings.version, models))
        elif message == packets.ECHO_REQUEST and len(data) == 12:
            self._reply(sender, packets.echo_response(data[4:], self.ticks(now)))
        elif message == packets.REQUEST:
            self._reply(sender, packets.packet(packets.UNRECOGNIZED_REQUEST, b""))
        self._clients[sender] = now
        if message == packets.DISCONNECT:
            del self._clients[sender]

    def _reply(self, receiver: tuple[str, int], data: bytes) -> None:
        self._command.sendto(data, receiver)


def _bound_socket(port: int) -> socket.socket:
    """Socket on the loopback interface only; its multicast stays there too."""
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.bind((HOST, port))
        result.setblocking(False)
        result.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(HOST))
        result.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        result.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
    except OSError as error:
        result.close()
        raise SimulationError(f"UDP port {port} of {HOST} cannot be used: {error.strerror}") from None
    return result


def _time_of_day_offset_ns() -> int:
    """Time of day minus monotonic time [ns], by the fastest of several readings."""
    readings = []
    for _ in range(3):
        before = time.monotonic_ns()
        now = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, now - (before + after) // 2))
    return min(readings)[1]
