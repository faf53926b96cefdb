"""A NatNet server without sockets and a session with it, in a world whose time is a number."""

import struct
from typing import Any

from knee_gap_perception.trackers.body_source import BodyFrame
from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_perception.trackers.natnet.session import NatNetSession
from knee_gap_simulation.natnet import packets as server

MOTIVE = ("10.0.0.5", 1510)
MILLISECOND = 1_000_000
SECOND = 1_000_000_000


class Motive:
    """A server without sockets, in a world whose time is a number."""

    def __init__(
        self,
        *,
        version: tuple[int, int] = (4, 1),
        frequency: int = 10_000_000,
        first_tick: int = 10**12,
        drift_ppm: float = 0.0,
    ) -> None:
        self.version, self.frequency, self.first_tick = version, frequency, first_tick
        self.rate = frequency * (1 + drift_ppm * 1e-6)
        self.names = {1: "scope", 2: "tibia"}
        self.number = 0
        self.echoes = True

    def ticks(self, now: int) -> int:
        return self.first_tick + round(now * self.rate / SECOND)

    def answer(self, request: bytes, now: int) -> bytes | None:
        message = struct.unpack_from("<H", request)[0]
        if message == MessageId.CONNECT:
            return server.server_info(
                self.version, frequency=self.frequency, data_port=1511, multicast_address=None
            )
        if message == MessageId.REQUEST_MODEL_DEFINITIONS:
            models = server.Models(bodies=[server.BodyModel(*item) for item in self.names.items()])
            return server.model_definitions(self.version, models)
        if message == MessageId.ECHO_REQUEST and self.echoes:
            return server.echo_response(request[4:], self.ticks(now))
        return None

    def frame(self, exposure: int, **changes: Any) -> bytes:
        self.number += 1
        bodies = [
            server.BodyInFrame(number, (float(number), 2.0, 3.0), (0.1, 0.2, 0.3, 0.927362))
            for number in self.names
        ]
        values: dict[str, Any] = {
            "number": self.number,
            "bodies": bodies,
            "mid_exposure_ticks": self.ticks(exposure),
        }
        return server.frame(self.version, server.FrameContent(**(values | changes)))


class World:
    """Client and server with a network of a given delay [ns] between them."""

    def __init__(
        self,
        motive: Motive | None = None,
        *,
        way: int = 100_000,
        back: int = 100_000,
        session: NatNetSession | None = None,
    ) -> None:
        self.motive = motive or Motive()
        self.session = session or NatNetSession(MOTIVE[0])
        self.way, self.back = way, back
        self.now = 50 * SECOND
        self.requests: list[int] = []

    def run(
        self,
        seconds: float,
        *,
        rate: float = 120.0,
        latency: int = 4 * MILLISECOND,
        up: bool = True,
        frames: bool = True,
        motive: Motive | None = None,
    ) -> list[tuple[BodyFrame, int]]:
        """Let time pass; return (frame, true exposure) of each frame that the session gave."""
        motive = motive or self.motive
        given: list[tuple[BodyFrame, int]] = []
        end, period = self.now + round(seconds * SECOND), round(SECOND / rate)
        while self.now < end:
            self.now += period
            for request in self.session.outgoing(self.now):
                self.requests.append(struct.unpack_from("<H", request)[0])
                if up and (answer := motive.answer(request, self.now + self.way)):
                    self.session.receive(answer, MOTIVE, self.now + self.way + self.back)
            if up and frames:
                exposure = self.now - latency
                frame = self.session.receive(motive.frame(exposure), MOTIVE, self.now + period // 2)
                if frame is not None:
                    given.append((frame, exposure))
        return given


def worst_stamp_error(given: list[tuple[BodyFrame, int]]) -> int:
    return max(abs(frame.stamp_ns - exposure) for frame, exposure in given)
