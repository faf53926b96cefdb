"""A session with a NatNet server: conversation, stamps, restarts."""

import struct

import numpy as np
import pytest
from motive_world import MILLISECOND, MOTIVE, SECOND, Motive, World, worst_stamp_error

from knee_gap_perception.trackers.natnet.clock import EchoClock
from knee_gap_perception.trackers.natnet.packets import MessageId
from knee_gap_perception.trackers.natnet.session import NatNetSession
from knee_gap_simulation.natnet import packets as server


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
