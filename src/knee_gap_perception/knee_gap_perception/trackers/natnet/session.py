"""Session with a NatNet server, without sockets: packets and times in, requests and frames out.

It connects, asks for the names of the bodies, keeps the connection alive, and maps the server's clock to the
local one by echoes. If the server is lost, it connects again, at growing intervals. Times are those of the
local monotonic clock [ns].
"""

from collections import Counter, deque

from knee_gap_core.values.poses import BodyPose
from knee_gap_core.values.stamps import NANOSECONDS
from knee_gap_perception.trackers.body_source import BodyFrame, SourceStatus
from knee_gap_perception.trackers.natnet import packets
from knee_gap_perception.trackers.natnet.buffer import PacketError
from knee_gap_perception.trackers.natnet.clock import OTHER_CLOCK_NS, EchoClock
from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_perception.trackers.natnet.schedule import (
    ECHO_NS,
    FINE_CLOCK_NS,
    FIRST_ECHO_NS,
    FIRST_ECHOES,
    FIRST_RETRY_NS,
    GONE_NS,
    KEEP_ALIVE_NS,
    LAST_RETRY_NS,
    MODELS_NS,
    MOST_FIRST_ECHOES,
    NO_DATA_NS,
    Due,
)
from knee_gap_perception.trackers.natnet.words import no_answer, no_data, nothing_usable
from knee_gap_perception.trackers.up_axis import position_z_up, quaternion_z_up

Address = tuple[str, int]

# A larger jump of the frame numbers is a server that counts from the start again, not a loss.
MOST_LOST = 100_000
# Largest age of a frame on arrival, and largest time in the future by the clock's error.
OLDEST_FRAME_NS = NANOSECONDS
NEWEST_FRAME_NS = 5_000_000
# Number of frames whose latencies are the reference while an echo contradicts the clock, and number of frames
# that must deviate before the server counts as restarted.
USUAL_LATENCIES = 64
FEWEST_NOT_FITTING = 2
FRAME_HEAD = int(MessageId.FRAME).to_bytes(2, "little")


class NatNetSession:
    """State of the session; `counts` are numbers of rejected packets by reason, for diagnostics.

    Only `command_port` of the server answers: packets other than frames are rejected from other ports.
    `group` is the multicast group that was joined, whatever the server reports.
    """

    def __init__(
        self,
        server: str,
        *,
        command_port: int = 1510,
        group: str = "239.255.42.99:1511",
        up_axis: str = "y",
        max_clock_error: float = 0.001,
    ) -> None:
        self.server = server
        self._group = group
        self._command_port = command_port
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
        # Names before the models changed, last time each body was in view, and why a model was rejected.
        self._former_names: dict[int, str] = {}
        self._seen_ns: dict[int, int] = {}
        self._renamed = ""
        # Recent latencies [ns], and counts of frames since an echo contradicted the clock.
        self._latencies_ns: deque[int] = deque(maxlen=USUAL_LATENCIES)
        self._fitting_ns: int | None = None
        self._not_fitting = 0
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
        """Process a packet; return its frame, if it contains one that can be stamped.

        `ros_offset_ns` is the ROS time minus that of the monotonic clock. No packet raises.
        """
        if sender[0] != self.server:
            self.counts["packets from other machines"] += 1
            self._other_ns, self._other_address = arrival_ns, sender[0]
            return None
        if data[:2] != FRAME_HEAD and sender[1] != self._command_port:
            self.counts["packets from other ports of the server"] += 1
            return None
        version = None if self.info is None else self.info.natnet_version
        if version is None and data[:1] != bytes([MessageId.SERVER_INFO]):
            self.counts["packets before the server's version"] += 1
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
            self._on_models(packet, arrival_ns)
        elif isinstance(packet, packets.EchoResponse):
            self._on_echo(packet, arrival_ns)
        elif isinstance(packet, packets.Unrecognized):
            self.counts["requests the server does not know"] += 1
        return None

    def status(self, now_ns: int) -> SourceStatus:
        """Return the status of the session."""
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
            words = no_data(name, silence_ns / NANOSECONDS, info, self._fault, other, self._group)
            return SourceStatus(False, words, values)
        if now_ns - max(self._given_ns, self._connected_ns) > NO_DATA_NS:
            error_ns = None if self.clock is None or self.clock.ready(now_ns) else self.clock.error_ns
            words = nothing_usable(name, bool(self.names), error_ns, self._renamed)
            return SourceStatus(False, words, values)
        words = f"frames received from {name}"
        if self.clock is None:
            words += "; stamps are times of arrival: there is no time of exposure before NatNet 3.0"
        if self._renamed:
            words += f"; a model definition that renames {self._renamed}, which is in view, is ignored"
        if self._other_ns and now_ns - self._other_ns < NO_DATA_NS:
            words += "; a second server sends as well and is ignored"
        return SourceStatus(True, words, values)

    def _start_over(self) -> None:
        self.counts["connections lost"] += 1
        self.info = None
        self.clock = None
        self.names = {}
        self._former_names = {}
        self._seen_ns.clear()
        self._data_from = None
        self._last_number = None
        self._connect = Due(every_ns=FIRST_RETRY_NS)

    def _on_server_info(self, info: packets.ServerInfo, arrival_ns: int) -> None:
        if info == self.info:
            return
        if self.info is not None and arrival_ns - self._frame_ns <= NO_DATA_NS:
            # It was not requested, and the connected server is still sending.
            self.counts["greetings of a server while another sends"] += 1
            return
        self.info = info
        self.names = {}
        self._former_names = {}
        self._models_wanted = True
        self._connected_ns = arrival_ns
        self._models.at_ns = self._echo.at_ns = self._keep_alive.at_ns = 0
        self._echo_count = 0
        self._echoes_sent.clear()
        self._latencies_ns.clear()
        self.clock = None
        if info.clock_frequency is not None:
            self.clock = EchoClock(info.clock_frequency, self._max_clock_error_ns)

    def _on_models(self, models: packets.ModelDefinitions, arrival_ns: int) -> None:
        if not self._models_wanted:
            self.counts["model definitions without a request"] += 1
            return
        self._renamed = self._renamed_in_view(models.bodies, arrival_ns)
        if self._renamed:
            self.counts["model definitions that rename bodies in view"] += 1
            return
        self.names = dict(models.bodies)
        self._former_names = {}
        self._models_wanted = False

    def _renamed_in_view(self, bodies: dict[int, str], arrival_ns: int) -> str:
        """Body in view that would get another name, in words; empty if none.

        The scope cannot become the tibia while both are in view. If the server reported that its models
        changed, a body may get a new name, but not that of another body in view.
        """
        known = self.names or self._former_names
        for number, name in known.items():
            if arrival_ns - self._seen_ns.get(number, -NO_DATA_NS) > NO_DATA_NS:
                continue
            moved = any(other == name and at != number for at, other in bodies.items())
            if moved or (self.names and bodies.get(number) != name):
                return f"'{name}' (id {number})"
        return ""

    def _on_echo(self, echo: packets.EchoResponse, arrival_ns: int) -> None:
        clock = self.clock
        if clock is None or echo.request_stamp not in self._echoes_sent:
            self.counts["echoes without a request"] += 1
            return
        self._echoes_sent.remove(echo.request_stamp)
        if not clock.in_doubt:
            self._fitting_ns, self._not_fitting = None, 0
        if clock.add(echo.request_stamp, arrival_ns, echo.server_ticks):
            return
        self.counts["echoes that contradict the clock"] += 1
        # Request another at once, so that the contradiction is resolved soon.
        self._echo_count = 0
        self._echo.at_ns = arrival_ns + FIRST_ECHO_NS
        if clock.another and self._has_another_clock(arrival_ns):
            clock.restart()
            self._latencies_ns.clear()

    def _has_another_clock(self, arrival_ns: int) -> bool:
        """Whether the server restarted: its frames do not fit the previous clock any more either.

        Echoes alone may be forged. Frames arrive on another path, and their latency would have jumped too.
        """
        if not self._latencies_ns or arrival_ns - self._frame_ns > NO_DATA_NS:
            return True
        fitting = self._fitting_ns is not None and arrival_ns - self._fitting_ns <= NO_DATA_NS
        return not fitting and self._not_fitting >= FEWEST_NOT_FITTING

    def _on_frame(
        self, frame: packets.Frame, sender: Address, arrival_ns: int, ros_offset_ns: int
    ) -> BodyFrame | None:
        if not self._is_my_server(sender, arrival_ns):
            return None
        self._frame_ns = arrival_ns
        self._connect.every_ns = FIRST_RETRY_NS
        if frame.models_changed and not self._models_changed:
            # An id may mean another body from now on: no name is better than a wrong one.
            self._former_names = self.names or self._former_names
            self.names = {}
            self._models_wanted = True
            self._models.at_ns = arrival_ns
        self._models_changed = frame.models_changed
        if any(body.id not in self.names for body in frame.bodies):
            self._models_wanted = True
        self._note_seen(frame, arrival_ns)
        if self._last_number is not None and 0 < frame.number - self._last_number - 1 < MOST_LOST:
            self.counts["frames lost"] += frame.number - self._last_number - 1
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

    def _note_seen(self, frame: packets.Frame, arrival_ns: int) -> None:
        """Store the last time at which each named body was in view."""
        for body in frame.bodies:
            if body.tracking_valid is not False and (body.id in self.names or body.id in self._former_names):
                self._seen_ns[body.id] = arrival_ns

    def _is_my_server(self, sender: Address, arrival_ns: int) -> bool:
        """Choose between two servers on one machine, which differ by their port only.

        One is kept while its frames can be used. The first can be the wrong one: its times do not fit the
        echoes. The ports that the server reported take precedence.
        """
        if self._data_from is not None and self._is_stated(sender) != self._is_stated(self._data_from):
            if not self._is_stated(sender):
                return self._is_second_server(arrival_ns)
            self._data_from = None
        silent = arrival_ns - self._frame_ns > NO_DATA_NS
        useless = arrival_ns - max(self._given_ns, self._data_since_ns) > NO_DATA_NS
        known = self.clock is None or self.clock.ready(arrival_ns)
        if self._data_from is None or silent or (sender != self._data_from and useless and known):
            self._data_from, self._data_since_ns = sender, arrival_ns
            self._last_number = None
        return sender == self._data_from or self._is_second_server(arrival_ns)

    def _is_stated(self, sender: Address) -> bool:
        """Whether frames are expected from a port: the command port, or the server's reported data port."""
        return sender[1] in (self._command_port, self.info.data_port if self.info is not None else None)

    def _is_second_server(self, arrival_ns: int) -> bool:
        """Count a frame of a server that is ignored; return False."""
        self.counts["frames of a second server"] += 1
        self._other_ns = arrival_ns
        return False

    def _stamp(self, frame: packets.Frame, arrival_ns: int) -> int | None:
        if self.clock is None or frame.mid_exposure_ticks is None:
            return arrival_ns
        known, unusual = self.clock.ready(arrival_ns), False
        if self.clock.in_doubt:
            latency_ns = arrival_ns - self.clock.local_ns(frame.mid_exposure_ticks)
            unusual = not self._is_usual(latency_ns, arrival_ns)
        if not known or unusual:
            doubt = "frames while the clock was in doubt"
            self.counts["frames before the clock was known" if not known else doubt] += 1
            return None
        stamp_ns = self.clock.local_ns(frame.mid_exposure_ticks)
        latency_ns = arrival_ns - stamp_ns
        self._latency_ns = latency_ns
        if not -NEWEST_FRAME_NS <= self._latency_ns <= OLDEST_FRAME_NS:
            self.counts["frames with an impossible time"] += 1
            self._echo_count = 0
            self._echo.at_ns = min(self._echo.at_ns, arrival_ns + FIRST_ECHO_NS)
            return None
        self._latencies_ns.append(latency_ns)
        return stamp_ns

    def _is_usual(self, latency_ns: int, arrival_ns: int) -> bool:
        """Whether a frame's latency is as before the contradicting echo; both outcomes are counted."""
        known = self._latencies_ns
        usual = bool(known) and min(known) <= latency_ns + OTHER_CLOCK_NS <= max(known) + 2 * OTHER_CLOCK_NS
        if usual:
            self._fitting_ns = arrival_ns
        self._not_fitting += not usual
        return usual
