import struct

import numpy as np
import pytest
from natnet_captures import CLOCK_HZ, TRAFFIC, traffic
from recordings import origins

from knee_gap_perception.trackers.body_source import UnknownBodyError, choose_body
from knee_gap_perception.trackers.natnet.clock import EchoClock
from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_perception.trackers.natnet.session import NatNetSession
from knee_gap_simulation.natnet import packets as server

MOTIVE = ("10.0.0.5", 1510)
MILLISECOND = 1_000_000
SECOND = 1_000_000_000


class Motive:
    """A server without sockets, in a world whose time is a number."""

    def __init__(self, *, version=(4, 1), frequency=10_000_000, first_tick=10**12, drift_ppm=0.0):
        self.version, self.frequency, self.first_tick = version, frequency, first_tick
        self.rate = frequency * (1 + drift_ppm * 1e-6)
        self.names = {1: "scope", 2: "tibia"}
        self.number = 0
        self.echoes = True

    def ticks(self, now):
        return self.first_tick + round(now * self.rate / SECOND)

    def answer(self, request, now):
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

    def frame(self, exposure, **changes):
        self.number += 1
        bodies = [
            server.BodyInFrame(number, (float(number), 2.0, 3.0), (0.1, 0.2, 0.3, 0.927362))
            for number in self.names
        ]
        values = {"number": self.number, "bodies": bodies, "mid_exposure_ticks": self.ticks(exposure)}
        return server.frame(self.version, server.FrameContent(**(values | changes)))


class World:
    """Client and server with a network of a given delay [ns] between them."""

    def __init__(self, motive=None, *, way=100_000, back=100_000, session=None):
        self.motive = motive or Motive()
        self.session = session or NatNetSession(MOTIVE[0])
        self.way, self.back = way, back
        self.now = 50 * SECOND
        self.requests = []

    def run(self, seconds, *, rate=120.0, latency=4 * MILLISECOND, up=True, frames=True, motive=None):
        """Let time pass; return (frame, true exposure) of each frame that the session gave."""
        motive = motive or self.motive
        given, end, period = [], self.now + round(seconds * SECOND), round(SECOND / rate)
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


def worst_stamp_error(given):
    return max(abs(frame.stamp_ns - exposure) for frame, exposure in given)


class TestConversation:
    @pytest.mark.parametrize("version", server.VERSIONS)
    def test_frames_come_with_names_within_a_third_of_a_second(self, version):
        world = World(Motive(version=version))
        given = world.run(2.0)
        assert len(given) > 200
        frame, _ = given[0]
        assert [body.name for body in frame.bodies] == ["scope", "tibia"]
        assert frame.names == {1: "scope", 2: "tibia"}
        assert not frame.stamp_is_arrival
        assert world.session.status(world.now).ok

    def test_y_up_becomes_z_up(self):
        (frame, _), *_ = World().run(1.0)
        np.testing.assert_allclose(frame.bodies[0].position, [1.0, -3.0, 2.0])
        np.testing.assert_allclose(frame.bodies[0].quaternion_xyzw, [0.1, -0.3, 0.2, 0.927362], rtol=1e-6)

    def test_it_is_kept_alive(self):
        world = World()
        world.run(10.0)
        assert world.requests.count(MessageId.KEEP_ALIVE) >= 19
        assert world.requests.count(MessageId.CONNECT) == 1

    def test_the_time_of_ros_is_added(self):
        world = World()
        world.run(1.0)
        exposure = world.now
        frame = world.session.receive(
            world.motive.frame(exposure), MOTIVE, world.now + 4 * MILLISECOND, 7 * SECOND
        )
        assert abs(frame.stamp_ns - 7 * SECOND - exposure) < MILLISECOND
        assert frame.bodies[0].stamp_ns == frame.stamp_ns

    def test_an_invalid_bit_and_the_mean_error_come_through(self):
        world = World()
        world.run(1.0)
        body = server.BodyInFrame(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0.25, tracking_valid=False)
        frame = world.session.receive(world.motive.frame(world.now, bodies=[body]), MOTIVE, world.now + 1)
        assert not frame.bodies[0].tracking_valid
        assert frame.bodies[0].mean_error == 0.25

    def test_natnet_2_gives_stamps_of_arrival_and_says_so(self):
        session = NatNetSession(MOTIVE[0])
        info = b"Motive".ljust(256, b"\0") + bytes([1, 7, 2, 0, 2, 7, 0, 0])
        models = struct.pack("<II", 1, 1) + b"scope\0" + struct.pack("<Ii3f", 1, -1, 0, 0, 0)
        body = struct.pack("<I3f4fIfH", 1, 0.5, 1, 2, 0, 0, 0, 1, 0, 1e-4, 1)
        # Latency, timecode and its part, time, flags, end mark.
        end = struct.pack("<fIIdHI", 0.01, 0, 0, 3.5, 0, 0)
        frame = struct.pack("<IIII", 9, 0, 0, 1) + body + struct.pack("<II", 0, 0) + end
        session.outgoing(SECOND)
        session.receive(server.packet(1, info), MOTIVE, SECOND)
        session.receive(server.packet(5, models), MOTIVE, SECOND)
        given = session.receive(server.packet(7, frame), MOTIVE, 2 * SECOND)
        assert given.stamp_ns == 2 * SECOND
        assert given.stamp_is_arrival
        assert given.bodies[0].stamp_is_arrival
        assert given.bodies[0].name == "scope"
        assert "times of arrival" in session.status(2 * SECOND).words


class TestStamps:
    @pytest.mark.parametrize(("drift_ppm", "seconds"), [(-100.0, 60), (0.0, 30), (100.0, 600)])
    def test_they_hold_for_ten_minutes_of_a_drifting_clock(self, drift_ppm, seconds):
        world = World(Motive(drift_ppm=drift_ppm))
        given = world.run(seconds, rate=20.0)
        assert len(given) > 20 * seconds - 30
        assert worst_stamp_error(given) < 0.4 * MILLISECOND
        assert worst_stamp_error(given[200:]) < 0.05 * MILLISECOND

    def test_slow_echoes_do_not_move_the_clock(self):
        rng = np.random.default_rng(3)
        world = World(Motive(drift_ppm=50.0))
        given = []
        for _ in range(120):
            delayed = rng.random() < 0.4
            world.way = 100_000 + delayed * int(rng.exponential(20 * MILLISECOND))
            given += world.run(0.5)
        assert len(given) > 5000
        assert worst_stamp_error(given) < MILLISECOND

    def test_they_never_run_backwards(self):
        world = World(Motive(drift_ppm=-80.0))
        stamps = [frame.stamp_ns for frame, _ in world.run(60.0)]
        assert (np.diff(stamps) > 0).all()

    def test_a_frame_that_was_overtaken_is_dropped(self):
        world = World()
        world.run(1.0)
        first, second = world.motive.frame(world.now - 8000), world.motive.frame(world.now)
        assert world.session.receive(second, MOTIVE, world.now + 1)
        assert world.session.receive(first, MOTIVE, world.now + 2) is None
        assert world.session.counts["frames out of order"] == 1

    @pytest.mark.parametrize("off", [-20.0, 0.5])
    def test_a_time_that_cannot_be_is_refused(self, off):
        world = World()
        world.run(1.0)
        frame = world.motive.frame(world.now + round(off * SECOND))
        assert world.session.receive(frame, MOTIVE, world.now + MILLISECOND) is None
        assert world.session.counts["frames with an impossible time"] == 1

    def test_frames_without_an_answer_to_echoes_are_not_stamped_at_all(self):
        motive = Motive()
        motive.echoes = False
        world = World(motive)
        assert world.run(3.0) == []
        assert "but no echoes" in world.session.status(world.now).words

    def test_nothing_is_stamped_before_the_clock_is_known_to_a_millisecond(self):
        world = World(way=5 * MILLISECOND)
        assert world.run(5.0) == []
        status = world.session.status(world.now)
        assert not status.ok
        assert "echoes take 5.1 ms: the time of exposure is known to 2.5 ms only" in status.words
        world.way = 1 * MILLISECOND
        assert worst_stamp_error(world.run(5.0)) < MILLISECOND

    def test_the_clock_alone(self):
        clock = EchoClock(1_000_000)
        assert not clock.ready(0)
        for index in range(6):
            clock.add(index * SECOND, index * SECOND + 2000, index * 1_000_000 + 5001)
        assert clock.ready(6 * SECOND)
        assert clock.local_ns(5001) == pytest.approx(1000, abs=1)
        assert clock.error_ns == 1000
        assert not clock.ready(100 * SECOND)


class TestRestarts:
    def test_the_server_comes_back_with_another_clock(self):
        world = World()
        world.run(5.0)
        assert world.run(4.0, up=False) == []
        assert "no answer from 10.0.0.5" in world.session.status(world.now).words
        again = Motive(first_tick=77, drift_ppm=-60.0)
        given = world.run(10.0, motive=again)
        assert len(given) > 900
        assert worst_stamp_error(given) < MILLISECOND
        assert world.session.counts["connections lost"] == 1

    def test_a_restart_too_quick_to_be_missed_gives_no_wrong_stamp(self):
        world = World()
        world.run(5.0)
        for first_tick in (3 * 10**12, 5):
            given = world.run(8.0, motive=Motive(first_tick=first_tick))
            assert len(given) > 500
            assert worst_stamp_error(given) < MILLISECOND

    def test_patience_grows_and_is_bounded(self):
        world = World()
        world.run(120.0, up=False)
        assert 30 <= world.requests.count(MessageId.CONNECT) <= 40

    def test_a_new_body_is_asked_for_and_named(self):
        world = World()
        world.run(2.0)
        world.motive.names = {1: "scope", 2: "tibia", 3: "femur"}
        given = world.run(4.0)
        assert [body.name for body in given[-1][0].bodies] == ["scope", "tibia", "femur"]

    def test_no_body_keeps_a_name_after_the_models_changed(self):
        world = World()
        world.run(2.0)
        world.motive.names = {1: "scope", 2: "femur"}
        changed = world.motive.frame(world.now, flags=server.MODELS_CHANGED)
        assert world.session.receive(changed, MOTIVE, world.now + 1) is None
        given = world.run(2.0)
        assert {body.name: body.position[0] for body in given[0][0].bodies} == {"scope": 1.0, "femur": 2.0}


class Forger:
    """Somebody on the network who knows what the session waits for, and sends as whom he likes."""

    def __init__(self, world, port):
        self.world, self.sender = world, (MOTIVE[0], port)

    def send(self, data):
        return self.world.session.receive(data, self.sender, self.world.now)

    def models(self, names):
        models = server.Models(bodies=[server.BodyModel(*item) for item in names.items()])
        self.send(server.model_definitions((4, 1), models))

    def echo(self, seconds, stamp=None):
        """An answer to the last echo, of a clock that is ahead."""
        waiting = self.world.session._echoes_sent
        stamp = stamp if stamp is not None else waiting[-1]
        ticks = self.world.motive.ticks(self.world.now + round(seconds * SECOND))
        self.send(server.echo_response(struct.pack("<Q", stamp), ticks))

    def greeting(self, group=None, version=(4, 1)):
        self.send(server.server_info(version, frequency=10**6, data_port=4000, multicast_address=group))


SWAPPED = {1: "tibia", 2: "scope"}


def names_and_places(given):
    return {(body.name, body.position[0]) for frame, _ in given for body in frame.bodies}


RIGHT = {("scope", 1.0), ("tibia", 2.0)}


class TestForgedPackets:
    @pytest.mark.parametrize("port", [1, 1509, 1511, 40000])
    def test_only_the_command_port_answers(self, port):
        world = World()
        world.run(2.0)
        forger, clock_error = Forger(world, port), world.session.clock.error_ns
        given = []
        for _ in range(50):
            world.session._models_wanted = True
            forger.models(SWAPPED)
            forger.models({})
            forger.greeting("239.1.2.3")
            world.session._echoes_sent.append(world.now - 1000)
            forger.echo(0.3)
            forger.send(server.packet(MessageId.UNRECOGNIZED_REQUEST, b""))
            forger.send(b"")
            given += world.run(0.1)
        assert len(given) > 500
        assert names_and_places(given) == RIGHT
        assert worst_stamp_error(given) < MILLISECOND
        assert world.session.counts["packets from other ports of the server"] == 300
        assert "requests the server does not know" not in world.session.counts
        assert world.session.info.multicast is False
        assert world.session.clock.error_ns <= clock_error

    def test_before_the_server_answered_another_port_does_not_either(self):
        world = World()
        world.session.outgoing(world.now)
        Forger(world, 1511).greeting("239.1.2.3")
        assert world.session.info is None
        assert len(world.run(2.0)) > 180

    @pytest.mark.parametrize("wanted", [False, True])
    @pytest.mark.parametrize(
        "names",
        [
            SWAPPED,
            {1: "tibia"},
            {2: "scope"},
            {1: "scope", 2: "scope"},
            {1: "else", 2: "tibia"},
            {1: "scope", 2: "tibia", 7: "scope"},
            {},
        ],
        ids=str,
    )
    def test_from_that_port_no_model_renames_a_body_in_view(self, names, wanted):
        world = World()
        world.run(2.0)
        given = []
        for _ in range(20):
            world.session._models_wanted = wanted
            Forger(world, MOTIVE[1]).models(names)
            given += world.run(0.1)
        assert len(given) > 200
        assert names_and_places(given) == RIGHT
        counts = world.session.counts
        reason = "that rename bodies in view" if wanted else "without a request"
        assert counts[f"model definitions {reason}"] == 20
        if wanted:
            world.session._models_wanted = True
            Forger(world, MOTIVE[1]).models(names)
            assert "which is in view, is ignored" in world.session.status(world.now).words

    def test_not_even_where_the_server_says_that_its_models_changed(self):
        world = World()
        world.run(2.0)
        world.motive.names = SWAPPED
        world.session.receive(world.motive.frame(world.now, flags=server.MODELS_CHANGED), MOTIVE, world.now)
        given = world.run(10.0)
        # Nothing is better than the tibia for the scope.
        assert given == []
        status = world.session.status(world.now)
        assert not status.ok
        assert "give the name of 'scope' (id 1), which is in view, to another body" in status.words

    def test_names_may_change_where_no_body_is_in_view(self):
        world = World()
        world.run(2.0)
        covered = [
            server.BodyInFrame(number, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), tracking_valid=False)
            for number in (1, 2)
        ]
        for number in range(150):
            world.now += 10 * MILLISECOND
            flags = {"flags": server.MODELS_CHANGED} if number == 149 else {}
            world.session.receive(
                world.motive.frame(world.now, bodies=covered, **flags), MOTIVE, world.now + MILLISECOND
            )
        world.motive.names = SWAPPED
        given = world.run(4.0)
        assert names_and_places(given) == {("tibia", 1.0), ("scope", 2.0)}

    def test_a_body_that_is_new_is_named_while_the_others_are_in_view(self):
        world = World()
        world.run(2.0)
        world.session._models_wanted = True
        Forger(world, MOTIVE[1]).models({1: "scope", 2: "tibia", 3: "femur"})
        assert world.session.names == {1: "scope", 2: "tibia", 3: "femur"}

    def test_another_greeting_changes_nothing_while_frames_come(self):
        world = World()
        world.run(2.0)
        given = []
        for version in ((3, 0), (4, 1)) * 10:
            Forger(world, MOTIVE[1]).greeting("239.1.2.3", version)
            given += world.run(0.1)
        assert len(given) > 200
        assert world.session.info.multicast is False
        assert world.session.counts["greetings of a server while another sends"] == 20

    @pytest.mark.parametrize("seconds", [-3600.0, -0.4, -0.02, 0.02, 0.3, 5.0])
    def test_an_echo_that_contradicts_the_clock_is_refused(self, seconds):
        world = World()
        given = world.run(5.0)
        for _ in range(10):
            world.session._echoes_sent.append(world.now - 1000)
            Forger(world, MOTIVE[1]).echo(seconds, world.now - 1000)
            given += world.run(0.5)
        assert len(given) > 1100
        assert worst_stamp_error(given) < MILLISECOND
        assert world.session.counts["echoes that contradict the clock"] == 10
        assert world.session.clock.restart_count == 0

    @pytest.mark.parametrize("seconds", [-0.4, 0.3, 5.0])
    def test_a_clock_that_is_forged_in_every_echo_is_not_followed(self, seconds):
        world = World()
        given = world.run(5.0)
        world.motive.echoes = False
        for _ in range(15 * 120):
            for stamp in list(world.session._echoes_sent):
                Forger(world, MOTIVE[1]).echo(seconds, stamp)
            given += world.run(0.01)
        assert worst_stamp_error(given) < MILLISECOND
        assert world.session.clock.restart_count == 0

    def test_an_echo_within_what_echoes_allow_is_taken(self):
        world = World()
        world.run(5.0)
        world.session._echoes_sent.append(world.now - 1000)
        Forger(world, MOTIVE[1]).echo(0.0005, world.now - 1000)
        assert "echoes that contradict the clock" not in world.session.counts
        assert worst_stamp_error(world.run(2.0)) < MILLISECOND

    def test_frames_of_another_port_are_not_taken_when_the_server_is_silent(self):
        world = World()
        world.run(2.0)
        frames = 0
        for _ in range(300):
            world.now += 10 * MILLISECOND
            forged = world.motive.frame(world.now)
            frames += world.session.receive(forged, (MOTIVE[0], 2000), world.now + MILLISECOND) is not None
        assert frames == 0
        assert world.session.counts["frames of a second server"] == 300


class TestTroubleInWords:
    def test_nobody_answers(self):
        world = World()
        world.run(3.0, up=False)
        status = world.session.status(world.now)
        assert not status.ok
        assert "no answer from 10.0.0.5 for 3 s" in status.words
        assert "firewall" in status.words

    def test_connected_but_no_data(self):
        world = World()
        world.run(5.0, frames=False)
        status = world.session.status(world.now)
        assert not status.ok
        assert "connected to Motive 3.1, NatNet 4.1, but no data for 5 s" in status.words
        assert "paused" in status.words

    def test_a_version_that_cannot_be_read(self):
        world = World(Motive(version=(4, 1)))
        world.session.outgoing(world.now)
        info = (
            b"Motive".ljust(256, b"\0")
            + bytes([4, 0, 0, 0, 5, 0, 0, 0])
            + struct.pack("<QHB4B", 10**7, 1, 0, *[0] * 4)
        )
        world.session.receive(server.packet(1, info), MOTIVE, world.now)
        world.session.receive(world.motive.frame(world.now), MOTIVE, world.now)
        assert "NatNet 5.0; 2.x to 4.x are supported" in world.session.status(world.now + 2 * SECOND).words

    def test_a_second_server_on_another_machine(self):
        world = World()
        world.run(1.0)
        assert world.session.receive(world.motive.frame(world.now), ("10.0.0.6", 1511), world.now) is None
        assert world.session.counts["packets from other machines"] == 1
        assert "second server" in world.session.status(world.now).words

    def test_a_second_server_on_the_same_machine(self):
        world = World()
        world.run(1.0)
        other = Motive(first_tick=4)
        for index in range(100):
            world.run(0.01)
            assert world.session.receive(other.frame(world.now), (MOTIVE[0], 2000), world.now + index) is None
        assert world.session.counts["frames of a second server"] == 100
        assert "second server" in world.session.status(world.now).words

    def test_the_wrong_one_of_two_on_a_machine_is_given_up_though_it_came_first(self):
        world, other, given = World(), Motive(first_tick=4), 0
        for _ in range(400):
            world.session.receive(other.frame(world.now), (MOTIVE[0], 2000), world.now)
            given += len(world.run(0.01))
        assert given > 150

    def test_a_body_that_is_not_there_is_told_those_that_are(self):
        (frame, _), *_ = World().run(1.0)
        with pytest.raises(
            UnknownBodyError, match=r"no rigid body 'skope'; it has: 'scope' \(id 1\), 'tibia'"
        ):
            choose_body(frame, "skope")
        with pytest.raises(UnknownBodyError, match="must be named"):
            choose_body(frame, "")

    @pytest.mark.parametrize("wanted", ["tibia", "2"])
    def test_a_body_is_chosen_by_name_or_id(self, wanted):
        (frame, _), *_ = World().run(1.0)
        body, others = choose_body(frame, wanted)
        assert body.name == "tibia"
        assert [other.name for other in others] == ["scope"]


class TestCapturedTraffic:
    @pytest.mark.parametrize("origin", origins(TRAFFIC))
    def test_a_recorded_conversation_is_read_to_the_end(self, origin):
        conversation = traffic(origin)
        frames, clock, asked = [], EchoClock(CLOCK_HZ), 0
        session = NatNetSession(conversation.server)
        for now, sender, port, data in udp_packets(conversation.capture):
            if sender != conversation.server:
                asked = now
                continue
            message = struct.unpack_from("<H", data)[0]
            if message == MessageId.ECHO_RESPONSE:
                clock.add(asked, now, struct.unpack_from("<Q", data, 12)[0])
            # The conversation is another client's: its echoes are not ours, so its clock is lent.
            session.receive(data, (sender, port), now)
            session.clock = clock
            if message == MessageId.FRAME and clock.ready(now):
                frames.append(session.receive(bumped(data), (sender, port), now))
        assert session.counts["malformed packets"] == 0
        assert session.names == conversation.names
        stamps = np.array([frame.stamp_ns for frame in frames if frame is not None])
        assert len(stamps) > 60
        assert np.median(np.diff(stamps)) == pytest.approx(8.333 * MILLISECOND, rel=0.01)
        assert (np.diff(stamps) > 0).all()
        assert clock.error_ns < MILLISECOND


def bumped(data):
    """The frame one tick later, so that the session does not take it for a repeat."""
    mid_exposure = len(data) - 6 - 24
    ticks = struct.unpack_from("<Q", data, mid_exposure)[0]
    return data[:mid_exposure] + struct.pack("<Q", ticks + 1) + data[mid_exposure + 8 :]


def udp_packets(capture):
    """Time [ns], sender, port and payload of each UDP packet of a pcapng file of Ethernet frames."""
    at = 0
    while at < len(capture):
        kind, length = struct.unpack_from("<II", capture, at)
        if kind == 6:
            high, low, captured = struct.unpack_from("<III", capture, at + 12)
            ip = capture[at + 28 + 14 : at + 28 + captured]
            udp = ip[(ip[0] & 15) * 4 :]
            port, _, size = struct.unpack_from(">HHH", udp)
            yield (high << 32 | low) * 1000, ".".join(map(str, ip[12:16])), port, udp[8:size]
        at += length
