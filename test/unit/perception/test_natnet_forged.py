"""NatNet packets that are forged, of a second server, or damaged."""

import struct

import pytest
from motive_world import MILLISECOND, MOTIVE, SECOND, World, worst_stamp_error

from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_simulation.natnet import packets as server


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
