"""One conversation with a NatNet server, without sockets: packets and times in, requests and frames out.

It connects, asks for the names of the bodies, keeps the connection alive, maps the server's clock to ours by
echoes, and starts over, ever more patiently, when the server goes away. Times are of the local monotonic
clock [ns].
"""

from collections import Counter, deque
from dataclasses import dataclass

from knee_gap_perception.optitrack import natnet_packets as packets
from knee_gap_perception.optitrack.body_source import BodyFrame, SourceStatus
from knee_gap_perception.optitrack.natnet_buffer import PacketError
from knee_gap_perception.optitrack.natnet_clock import NANOSECONDS, EchoClock
from knee_gap_perception.optitrack.natnet_packets import MessageId
from knee_gap_perception.optitrack.natnet_words import no_answer, no_data, nothing_usable
from knee_gap_perception.optitrack.up_axis import position_z_up, quaternion_z_up
from knee_gap_perception.poses import BodyPose

Address = tuple[str, int]

FIRST_RETRY_NS = NANOSECONDS // 4
LAST_RETRY_NS = 4 * NANOSECONDS
ECHO_NS = NANOSECONDS // 2
# The first echoes follow each other closely, so that stamps are there soon; more of them while the clock is
# known only roughly.
FIRST_ECHOES = 8
MOST_FIRST_ECHOES = 60
FINE_CLOCK_NS = 100_000
FIRST_ECHO_NS = 20_000_000
KEEP_ALIVE_NS = NANOSECONDS // 2
MODELS_NS = 2 * NANOSECONDS
# Without any packet for so long the server is gone; without a frame, there is no data.
GONE_NS = 2 * NANOSECONDS
NO_DATA_NS = NANOSECONDS
# A jump of the frame numbers beyond this is a server that counts anew, not a loss.
MOST_LOST = 100_000
# How old a frame may be when it arrives, and how far in the future the clock's error may put it.
OLDEST_FRAME_NS = NANOSECONDS
NEWEST_FRAME_NS = 5_000_000


@dataclass
class Due:
    """When something is to be sent next [ns], and how long after that again."""

    at_ns: int = 0
    every_ns: int = 0

    def take(self, now_ns: int) -> bool:
        """Whether it is due; if so, it is put off by its interval."""
        if now_ns < self.at_ns:
            return False
        self.at_ns = now_ns + self.every_ns
        return True


class NatNetSession:
    """State of the conversation; `counts` holds what was refused, for diagnostics."""

    def __init__(self, server: str, *, up_axis: str = "y", max_clock_error: float = 0.001) -> None:
        self.server = server
        self.counts: Counter[str] = Counter()
        self.info: packets.ServerInfo | None = None
        self.names: dict[int, str] = {}
        self.clock: EchoClock | None = None
        self._up_axis = up_axis
        self._max_clock_error_ns = max_clock_error * NANOSECONDS
        self._started_ns: int | None = None
        self._heard_ns = 0
        self._frame_ns = 0
        self._connected_ns = 0
        self._latency_ns = 0
        self._last_number: int | None = None
        self._data_from: Address | None = None
        self._data_since_ns = 0
        self._other_ns = 0
        self._other_address = ""
        self._fault = ""
        self._given_ns = 0
        self._stamp_ns = 0
        self._models_wanted = True
        self._models_changed = False
        self._connect = Due(every_ns=FIRST_RETRY_NS)
        self._models = Due(every_ns=MODELS_NS)
        self._keep_alive = Due(every_ns=KEEP_ALIVE_NS)
        self._echo = Due(every_ns=ECHO_NS)
        self._echoes_sent: deque[int] = deque(maxlen=16)
        self._echo_count = 0

    def outgoing(self, now_ns: int) -> list[bytes]:
        """Return the requests that are due."""
        if self._started_ns is None:
            self._started_ns = now_ns
        if self.info is not None and now_ns - self._heard_ns > GONE_NS:
            self._start_over()
        silent = self.info is None or now_ns - self._frame_ns > NO_DATA_NS
        due = []
        if silent and self._connect.take(now_ns):
            self._connect.every_ns = min(2 * self._connect.every_ns, LAST_RETRY_NS)
            due.append(packets.connect_request())
        if self.info is None:
            return due
        if self._models_wanted and self._models.take(now_ns):
            due.append(packets.encode_request(MessageId.REQUEST_MODEL_DEFINITIONS))
        if self._keep_alive.take(now_ns):
            due.append(packets.encode_request(MessageId.KEEP_ALIVE))
        if self.clock is not None and self._echo.take(now_ns):
            rough = self.clock.error_ns > FINE_CLOCK_NS and self._echo_count < MOST_FIRST_ECHOES
            if self._echo_count < FIRST_ECHOES or rough:
                self._echo.at_ns = now_ns + FIRST_ECHO_NS
            self._echo_count += 1
            self._echoes_sent.append(now_ns)
            due.append(packets.echo_request(now_ns))
        return due

    def receive(
        self, data: bytes, sender: Address, arrival_ns: int, ros_offset_ns: int = 0
    ) -> BodyFrame | None:
        """Take a packet; return the frame that it holds, if it holds one that can be stamped.

        `ros_offset_ns` is the time of ROS minus that of the monotonic clock. Nothing in a packet raises.
        """
        if sender[0] != self.server:
            self.counts["packets from other machines"] += 1
            self._other_ns, self._other_address = arrival_ns, sender[0]
            return None
        version = None if self.info is None else self.info.natnet_version
        if version is None and data[:1] != bytes([MessageId.SERVER_INFO]):
            self.counts["packets before the server told its version"] += 1
            return None
        try:
            packet = packets.decode_packet(data, version)
        except PacketError as error:
            self.counts["malformed packets"] += 1
            self._fault = str(error)
            return None
        self._heard_ns = arrival_ns
        if isinstance(packet, packets.Frame):
            return self._on_frame(packet, sender, arrival_ns, ros_offset_ns)
        if isinstance(packet, packets.ServerInfo):
            self._on_server_info(packet, arrival_ns)
        elif isinstance(packet, packets.ModelDefinitions):
            self._on_models(packet)
        elif isinstance(packet, packets.EchoResponse):
            self._on_echo(packet, arrival_ns)
        elif isinstance(packet, packets.Unrecognized):
            self.counts["requests the server does not know"] += 1
        return None

    def status(self, now_ns: int) -> SourceStatus:
        """Return how the conversation fares, in plain words."""
        values: dict[str, object] = dict(sorted(self.counts.items()))
        info = self.info
        if info is None:
            waited = (now_ns - max(self._started_ns or now_ns, self._heard_ns)) / NANOSECONDS
            return SourceStatus(False, no_answer(self.server, waited, self._fault), values)
        name = f"{info.application} {info.application_version}, NatNet {info.natnet_version}"
        values["server"] = f"{name}, at {self.server}"
        values["bodies"] = ", ".join(f"{name} ({number})" for number, name in sorted(self.names.items()))
        if self.clock is not None:
            values["clock error (ms)"] = self.clock.error_ns / 1e6
            values["clock restarts"] = self.clock.restart_count
            values["latency (ms)"] = self._latency_ns / 1e6
        silence_ns = now_ns - max(self._frame_ns, self._connected_ns)
        if silence_ns > NO_DATA_NS:
            other = self._other_address if now_ns - self._other_ns < NO_DATA_NS else ""
            words = no_data(name, silence_ns / NANOSECONDS, info, self._fault, other)
            return SourceStatus(False, words, values)
        if now_ns - max(self._given_ns, self._connected_ns) > NO_DATA_NS:
            error_ns = None if self.clock is None or self.clock.ready(now_ns) else self.clock.error_ns
            return SourceStatus(False, nothing_usable(name, bool(self.names), error_ns), values)
        words = f"frames come from {name}"
        if self.clock is None:
            words += "; stamps are times of arrival: before NatNet 3.0 the time of exposure is not told"
        if self._other_ns and now_ns - self._other_ns < NO_DATA_NS:
            words += "; a second server sends as well and is not listened to"
        return SourceStatus(True, words, values)

    def _start_over(self) -> None:
        self.counts["connections lost"] += 1
        self.info = None
        self.clock = None
        self.names = {}
        self._data_from = None
        self._last_number = None
        self._connect = Due(every_ns=FIRST_RETRY_NS)

    def _on_server_info(self, info: packets.ServerInfo, arrival_ns: int) -> None:
        if info == self.info:
            return
        self.info = info
        self.names = {}
        self._models_wanted = True
        self._connected_ns = arrival_ns
        self._models.at_ns = self._echo.at_ns = self._keep_alive.at_ns = 0
        self._echo_count = 0
        self._echoes_sent.clear()
        self.clock = None
        if info.clock_frequency is not None:
            self.clock = EchoClock(info.clock_frequency, self._max_clock_error_ns)

    def _on_models(self, models: packets.ModelDefinitions) -> None:
        self.names = dict(models.bodies)
        self._models_wanted = False

    def _on_echo(self, echo: packets.EchoResponse, arrival_ns: int) -> None:
        if self.clock is None or echo.request_stamp not in self._echoes_sent:
            self.counts["echoes not asked for"] += 1
            return
        self._echoes_sent.remove(echo.request_stamp)
        restarts = self.clock.restart_count
        self.clock.add(echo.request_stamp, arrival_ns, echo.server_ticks)
        if self.clock.restart_count != restarts:
            self._echo_count = 0
            self._echo.at_ns = arrival_ns

    def _on_frame(
        self, frame: packets.Frame, sender: Address, arrival_ns: int, ros_offset_ns: int
    ) -> BodyFrame | None:
        if not self._is_my_server(sender, arrival_ns):
            return None
        self._frame_ns = arrival_ns
        self._connect.every_ns = FIRST_RETRY_NS
        if frame.models_changed and not self._models_changed:
            # An id may mean another body from here on: better no name than a wrong one.
            self.names = {}
            self._models.at_ns = arrival_ns
        self._models_changed = frame.models_changed
        if any(body.id not in self.names for body in frame.bodies):
            self._models_wanted = True
        if self._last_number is not None and 0 < frame.number - self._last_number - 1 < MOST_LOST:
            self.counts["frames lost on the way"] += frame.number - self._last_number - 1
        self._last_number = frame.number
        stamp_ns = self._stamp(frame, arrival_ns)
        if stamp_ns is None:
            return None
        if not self.names:
            self.counts["frames before the bodies' names were known"] += 1
            return None
        if stamp_ns <= self._stamp_ns:
            self.counts["frames out of order"] += 1
            return None
        self._stamp_ns = stamp_ns
        self._given_ns = arrival_ns
        exposure_known = frame.mid_exposure_ticks is not None and self.clock is not None
        bodies = tuple(
            BodyPose(
                stamp_ns=stamp_ns + ros_offset_ns,
                position=position_z_up(body.position, self._up_axis),
                quaternion_xyzw=quaternion_z_up(body.quaternion_xyzw, self._up_axis),
                name=self.names[body.id],
                tracking_valid=body.tracking_valid is not False,
                mean_error=body.mean_error,
                stamp_is_arrival=not exposure_known,
            )
            for body in frame.bodies
            if body.id in self.names
        )
        return BodyFrame(stamp_ns + ros_offset_ns, bodies, self.names, not exposure_known)

    def _is_my_server(self, sender: Address, arrival_ns: int) -> bool:
        """Two servers on one machine differ by their port only; one is kept while its frames can be used.

        The first may be the one that the conversation is not with: its times do not fit the echoes.
        """
        silent = arrival_ns - self._frame_ns > NO_DATA_NS
        useless = arrival_ns - max(self._given_ns, self._data_since_ns) > NO_DATA_NS
        known = self.clock is None or self.clock.ready(arrival_ns)
        if self._data_from is None or silent or (sender != self._data_from and useless and known):
            self._data_from, self._data_since_ns = sender, arrival_ns
            self._last_number = None
        if sender == self._data_from:
            return True
        self.counts["frames of a second server"] += 1
        self._other_ns = arrival_ns
        return False

    def _stamp(self, frame: packets.Frame, arrival_ns: int) -> int | None:
        if self.clock is None or frame.mid_exposure_ticks is None:
            return arrival_ns
        if not self.clock.ready(arrival_ns):
            self.counts["frames before the clock was known"] += 1
            return None
        stamp_ns = self.clock.local_ns(frame.mid_exposure_ticks)
        self._latency_ns = arrival_ns - stamp_ns
        if not -NEWEST_FRAME_NS <= self._latency_ns <= OLDEST_FRAME_NS:
            self.counts["frames whose time cannot be"] += 1
            self._echo_count = 0
            self._echo.at_ns = min(self._echo.at_ns, arrival_ns + FIRST_ECHO_NS)
            return None
        return stamp_ns
