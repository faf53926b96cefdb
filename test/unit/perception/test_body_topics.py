from types import SimpleNamespace

import numpy as np
import pytest
from plain_messages import header, pose
from scipy.spatial.transform import Rotation

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.trackers.body_source import UnknownBodyError, choose_body
from knee_gap_perception.trackers.natnet.client import NatNetParameters
from knee_gap_perception.trackers.pose_topic import PoseTopics
from knee_gap_perception.trackers.rigid_bodies import RigidBodiesTopic
from knee_gap_perception.trackers.scope_feed import SOURCES, ScopeFeed, SourceParameters

MILLISECOND = 1_000_000


def stamped(stamp_ns, position=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    return SimpleNamespace(
        header=header(stamp_ns, "map"), pose=pose(position, Rotation.from_rotvec(turn).as_quat())
    )


class TestPoseTopics:
    def test_one_topic_comes_through_as_it_is(self):
        source = PoseTopics(["scope"])
        for index in range(3):
            source.put("scope", stamped(index * MILLISECOND, (0.1, 0.2, 0.3)))
        frames = source.poll()
        assert [frame.stamp_ns for frame in frames] == [0, MILLISECOND, 2 * MILLISECOND]
        np.testing.assert_array_equal(frames[0].bodies[0].position, [0.1, 0.2, 0.3])
        assert choose_body(frames[0], "")[0].name == "scope"
        assert source.poll() == []

    def test_y_up_is_turned(self):
        source = PoseTopics(["scope"], up_axis="y")
        source.put("scope", stamped(0, (0.1, 0.2, 0.3), (0.0, 0.4, 0.0)))
        (frame,) = source.poll()
        np.testing.assert_allclose(frame.bodies[0].position, [0.1, -0.3, 0.2])
        rotvec = Rotation.from_quat(frame.bodies[0].quaternion_xyzw).as_rotvec()
        np.testing.assert_allclose(rotvec, [0.0, 0.0, 0.4])

    @pytest.mark.parametrize("first", ["scope", "tibia"])
    def test_poses_of_one_stamp_belong_together_whichever_comes_first(self, first):
        source = PoseTopics(["scope", "tibia"])
        second = "tibia" if first == "scope" else "scope"
        source.put(first, stamped(MILLISECOND))
        source.put(second, stamped(MILLISECOND))
        (frame,) = source.poll()
        assert [body.name for body in frame.bodies] == ["scope", "tibia"]

    def test_the_leg_is_interpolated_to_the_scope_and_never_beyond(self):
        source = PoseTopics(["scope", "tibia"])
        source.put("tibia", stamped(0, (0.0, 0.0, 0.0)))
        source.put("scope", stamped(4 * MILLISECOND))
        assert source.poll() == []
        source.put("tibia", stamped(8 * MILLISECOND, (0.008, 0.0, 0.0), (0.0, 0.0, 0.2)))
        (frame,) = source.poll()
        leg = frame.bodies[1]
        assert leg.stamp_ns == frame.stamp_ns
        np.testing.assert_allclose(leg.position, [0.004, 0.0, 0.0])
        np.testing.assert_allclose(Rotation.from_quat(leg.quaternion_xyzw).as_rotvec(), [0.0, 0.0, 0.1])

    def test_the_scope_does_not_wait_for_ever_for_a_leg_that_is_gone(self):
        source = PoseTopics(["scope", "tibia"], max_wait=0.05)
        frames = []
        for index in range(20):
            source.put("scope", stamped(index * 10 * MILLISECOND))
            frames += source.poll()
        assert len(frames) == 14
        assert all(len(frame.bodies) == 1 for frame in frames)

    def test_a_malformed_leg_is_not_interpolated(self):
        source = PoseTopics(["scope", "tibia"])
        source.put("tibia", stamped(0, (float("nan"), 0.0, 0.0)))
        source.put("tibia", stamped(8 * MILLISECOND))
        source.put("scope", stamped(4 * MILLISECOND))
        source.put("scope", stamped(80 * MILLISECOND))
        frame, *_ = source.poll()
        assert [body.name for body in frame.bodies] == ["scope"]

    def test_a_bag_that_starts_again_is_not_joined_to_its_end(self):
        source = PoseTopics(["scope", "tibia"])
        for stamp in (100, 110, 120):
            source.put("tibia", stamped(stamp * MILLISECOND))
            source.put("scope", stamped(stamp * MILLISECOND))
        source.poll()
        source.put("tibia", stamped(1 * MILLISECOND))
        source.put("scope", stamped(2 * MILLISECOND))
        assert source.poll() == []
        source.put("tibia", stamped(3 * MILLISECOND, (0.5, 0.0, 0.0)))
        (frame,) = source.poll()
        np.testing.assert_allclose(frame.bodies[1].position, [0.25, 0.0, 0.0])

    def test_silent_topics_are_named(self):
        source = PoseTopics(["scope", "tibia"])
        source.put("scope", stamped(0))
        status = source.status()
        assert not status.ok
        assert "no poses of tibia" in status.words
        assert "scope, tibia" in source.status().words


class TestRigidBodies:
    def message(self, stamp_ns, *bodies):
        return SimpleNamespace(
            header=header(stamp_ns),
            frame_number=7,
            rigidbodies=[
                SimpleNamespace(rigid_body_name=name, markers=[], pose=pose(position))
                for name, position in bodies
            ],
        )

    def test_bodies_are_chosen_by_name_or_by_number(self):
        source = RigidBodiesTopic()
        source.put(self.message(5, ("12", (0.0, 0.0, 1.0)), ("scope", (0.0, 0.0, 2.0))))
        (frame,) = source.poll()
        assert choose_body(frame, "scope")[0].position[2] == 2.0
        assert choose_body(frame, "12")[0].position[2] == 1.0
        with pytest.raises(UnknownBodyError, match=r"it has: '12' \(id 12\), 'scope' \(id 13\)"):
            choose_body(frame, "femur")
        assert source.status().ok
        assert not source.status().ok

    def test_a_body_that_was_seen_before_is_known_while_it_is_hidden(self):
        source = RigidBodiesTopic()
        source.put(self.message(5, ("scope", (0.0, 0.0, 1.0)), ("tibia", (0.0, 0.0, 2.0))))
        source.put(self.message(6, ("tibia", (0.0, 0.0, 2.0))))
        body, others = choose_body(source.poll()[1], "scope")
        assert body is None
        assert [other.name for other in others] == ["tibia"]

    def test_y_up_is_turned(self):
        source = RigidBodiesTopic(up_axis="y")
        source.put(self.message(5, ("scope", (0.1, 0.2, 0.3))))
        np.testing.assert_allclose(source.poll()[0].bodies[0].position, [0.1, -0.3, 0.2])

    def test_memory_is_bounded_when_nobody_asks(self):
        source = RigidBodiesTopic()
        for index in range(1000):
            source.put(self.message(index, ("scope", (0.0, 0.0, 1.0))))
        assert len(source.poll()) == 64


class TestScopeFeed:
    def test_pose_topics_with_a_leg(self):
        feed = ScopeFeed(SourceParameters(), other_bodies={"tibia": "reference_body/pose"})
        topics = {one.topic: one.put for one in feed.source.subscriptions}
        assert list(topics) == ["scope_body/pose", "reference_body/pose"]
        for put in topics.values():
            put(stamped(5 * MILLISECOND))
        ((body, others),) = feed.poll()
        assert body.name == "scope"
        assert [other.name for other in others] == ["tibia"]

    def test_rigid_bodies_by_name_and_an_unknown_one_in_words(self):
        message = TestRigidBodies().message(5, ("scope", (0.0, 0.2, 1.0)), ("tibia", (0.0, 0.0, 2.0)))
        feed = ScopeFeed(SourceParameters(source="rigid_bodies", body="scope", up_axis="y"))
        feed.source.put(message)
        ((body, _),) = feed.poll()
        np.testing.assert_allclose(body.position, [0.0, -1.0, 0.2])
        assert feed.status().ok
        wrong = ScopeFeed(SourceParameters(source="rigid_bodies", body="skope"))
        wrong.source.put(message)
        assert wrong.poll() == []
        status = wrong.status()
        assert not status.ok
        assert "no rigid body 'skope'; it has: 'scope' (id 1), 'tibia' (id 2)" in status.words

    @pytest.mark.parametrize("source", SOURCES)
    def test_every_source_waits_by_itself_or_has_topics(self, source):
        feed = ScopeFeed(SourceParameters(source=source), NatNetParameters(command_port=9))
        assert feed.source.waits != bool(feed.source.subscriptions)
        for subscription in feed.source.subscriptions:
            assert subscription.msgtype.count("/") == 2
        feed.close()

    def test_natnet_waits_for_its_server(self):
        parameters = NatNetParameters(command_port=9)
        feed = ScopeFeed(SourceParameters(source="natnet", body="scope"), parameters)
        assert feed.poll(0.01) == []
        assert "no answer from 127.0.0.1" in feed.status().words
        feed.close()

    @pytest.mark.parametrize(
        ("source", "up_axis", "meant"),
        [("natnet", "auto", "y"), ("pose", "auto", "z"), ("pose", "y", "y"), ("natnet", "z", "z")],
    )
    def test_which_axis_is_up(self, source, up_axis, meant):
        assert SourceParameters(source=source, up_axis=up_axis).resolved_up_axis() == meant

    def test_an_unknown_source_is_refused_with_those_there_are(self):
        choices = ", ".join(SOURCES)
        with pytest.raises(PerceptionError, match=f"source must be one of {choices}, not 'vicon'"):
            SourceParameters(source="vicon")
