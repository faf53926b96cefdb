"""What a NatNet session reports in words, and captured traffic."""

import struct

import numpy as np
import pytest
from motive_world import MILLISECOND, MOTIVE, SECOND, Motive, World
from natnet_captures import CLOCK_HZ, TRAFFIC, traffic
from recordings import origins

from knee_gap_perception.trackers.body_source import UnknownBodyError, choose_body
from knee_gap_perception.trackers.natnet.clock import EchoClock
from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_perception.trackers.natnet.session import NatNetSession
from knee_gap_simulation.natnet import packets as server


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
