from dataclasses import replace
from math import inf, nan, pi, radians
from types import SimpleNamespace

import numpy as np
import pytest
from plain_messages import header, pose
from scipy.spatial.transform import Rotation
from tracked_hand import AT_BODY, PERIOD_NS, START_NS, hand_motion, moved, reasons

from knee_gap_core.conversions.pose_messages import body_pose_from_message, fill_lens_pose, fill_transform
from knee_gap_core.values.poses import BodyPose, FramePose, LensPose, rigid_transform
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.pose_validity import RefusalReason, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters


class TestLensPose:
    def test_a_straight_scope_on_an_identity_transform_is_the_body(self):
        tracker = ScopeTracker(replace(AT_BODY, oblique_angle=0.0))
        body = hand_motion(7)
        lens = tracker.update(body)
        assert isinstance(lens, LensPose)
        assert lens.stamp_ns == body.stamp_ns
        assert (lens.frame_id, lens.child_frame_id) == ("world", "arthroscope_optical")
        np.testing.assert_allclose(
            lens.matrix(), rigid_transform(body.position, body.quaternion_xyzw), atol=1e-12
        )

    def test_the_oblique_tip_looks_up_by_its_angle(self):
        upright = BodyPose(START_NS, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        view = ScopeTracker(AT_BODY).update(upright).matrix()[:3, 2]
        assert np.degrees(np.arccos(view[2])) == pytest.approx(30.0)
        assert view[1] == pytest.approx(-0.5)  # y is down in the picture

    def test_it_is_the_composition_of_body_shaft_and_tip(self):
        shaft = Rotation.from_euler("xyz", [10, -20, 35], degrees=True)
        parameters = TrackingParameters(
            body_to_shaft_translation=(0.01, -0.02, 0.2),
            body_to_shaft_quaternion_xyzw=tuple(shaft.as_quat()),
            oblique_angle=radians(70.0),
        )
        body = hand_motion(3)
        lens = ScopeTracker(parameters).update(body)
        ahead_of_tip = np.array([0.0, 0.0, 0.015])
        in_shaft = Rotation.from_euler("x", 70, degrees=True).apply(ahead_of_tip)
        in_body = shaft.apply(in_shaft) + np.array([0.01, -0.02, 0.2])
        in_world = Rotation.from_quat(body.quaternion_xyzw).apply(in_body) + body.position
        np.testing.assert_allclose((lens.matrix() @ [*ahead_of_tip, 1.0])[:3], in_world, atol=1e-12)

    @pytest.mark.parametrize("point", ["lens", "body"])
    def test_covariance_is_what_noise_on_that_point_does(self, point):
        rng = np.random.default_rng(5)
        parameters = TrackingParameters(
            body_to_shaft_translation=(0.0, 0.03, 0.25),
            translation_error=1e-4,
            rotation_error=1e-3,
            translation_error_at=point,
        )
        body = hand_motion(11)
        stated = ScopeTracker(parameters).update(body)
        T_body_lens = parameters.body_to_lens()
        T_world_body = rigid_transform(body.position, body.quaternion_xyzw)
        lens_true = T_world_body @ T_body_lens
        pivot = (lens_true if point == "lens" else T_world_body)[:3, 3]
        runs = 20_000
        shifts = rng.normal(0, 1e-4 / np.sqrt(3), (runs, 3))
        turns = rng.normal(0, 1e-3 / np.sqrt(3), (runs, 3))
        positions = (
            pivot + shifts + Rotation.from_rotvec(turns).apply(np.tile(lens_true[:3, 3] - pivot, (runs, 1)))
        )
        errors = np.hstack([positions - lens_true[:3, 3], turns])
        scale = np.sqrt(np.diag(stated.covariance))
        np.testing.assert_allclose(
            np.cov(errors.T) / np.outer(scale, scale),
            stated.covariance / np.outer(scale, scale),
            atol=5 / np.sqrt(runs),
        )

    def test_errors_are_lengths_of_vectors(self):
        covariance = (
            ScopeTracker(replace(AT_BODY, translation_error=0.003, rotation_error=0.006))
            .update(hand_motion(0))
            .covariance
        )
        assert np.sqrt(np.trace(covariance[:3, :3])) == pytest.approx(0.003)
        assert np.sqrt(np.trace(covariance[3:, 3:])) == pytest.approx(0.006)


class TestRefusals:
    def test_a_hand_held_scope_is_never_refused(self):
        tracker = ScopeTracker(AT_BODY)
        assert set(reasons(tracker, (hand_motion(i) for i in range(500)))) == {None}
        assert tracker.accepted_count == 500
        assert tracker.validity.period == pytest.approx(PERIOD_NS / 1e9)

    @pytest.mark.parametrize(
        ("fault", "reason"),
        [
            ({"tracking_valid": False}, RefusalReason.NOT_TRACKED),
            ({"position": np.array([0.0, nan, 0.0])}, RefusalReason.NOT_FINITE),
            ({"position": np.array([inf, 0.0, 0.0])}, RefusalReason.NOT_FINITE),
            ({"quaternion_xyzw": np.array([0.0, 0.0, 0.0, nan])}, RefusalReason.NOT_FINITE),
            ({"quaternion_xyzw": np.zeros(4)}, RefusalReason.NOT_UNIT),
            ({"quaternion_xyzw": np.array([0.0, 0.0, 0.0, 1.01])}, RefusalReason.NOT_UNIT),
            ({"mean_error": 0.0011}, RefusalReason.MEAN_ERROR),
        ],
    )
    def test_a_malformed_pose_is_refused_and_the_next_is_taken(self, fault, reason):
        tracker = ScopeTracker(AT_BODY)
        bodies = [hand_motion(i) for i in range(21)]
        bodies[10] = replace(bodies[10], **fault)
        found = reasons(tracker, bodies)
        assert found[10] is reason
        assert set(found[:10] + found[11:]) == {None}
        assert tracker.validity.counts == {reason: 1}

    def test_no_stamp(self):
        assert reasons(ScopeTracker(AT_BODY), [replace(hand_motion(0), stamp_ns=0)]) == [
            RefusalReason.NO_STAMP
        ]

    def test_duplicates(self):
        bodies = [hand_motion(i // 2) for i in range(20)]
        assert reasons(ScopeTracker(AT_BODY), bodies) == [None, RefusalReason.DUPLICATE] * 10

    def test_a_bag_that_starts_again_starts_afresh(self):
        bodies = [hand_motion(i) for i in range(100)]
        tracker = ScopeTracker(AT_BODY)
        found = reasons(tracker, bodies * 3)
        assert found.count(RefusalReason.STAMP_BACKWARDS) == 2
        assert found.count(None) == 298

    def test_a_frozen_driver_is_refused_from_its_first_repeat(self):
        bodies = [hand_motion(i) for i in range(60)]
        for i in range(20, 40):
            bodies[i] = replace(bodies[19], stamp_ns=bodies[i].stamp_ns)
        found = reasons(ScopeTracker(AT_BODY), bodies)
        assert found[20:40] == [RefusalReason.FROZEN] * 20
        assert found[40] is RefusalReason.GAP
        assert set(found[:20] + found[41:]) == {None}

    def test_a_gap_of_more_than_two_periods(self):
        rng = np.random.default_rng(1)
        one_lost = [
            replace(hand_motion(i), stamp_ns=hand_motion(i).stamp_ns + int(rng.normal(0, 2e5)))
            for i in range(40)
            if i != 20
        ]
        assert set(reasons(ScopeTracker(AT_BODY), one_lost)) == {None}
        two_lost = [hand_motion(i) for i in range(40) if i not in (20, 21)]
        found = reasons(ScopeTracker(AT_BODY), two_lost)
        assert found[20] is RefusalReason.GAP
        assert found.count(None) == 37

    def test_a_set_rate_is_used_at_once(self):
        tracker = ScopeTracker(AT_BODY, validity=ValidityParameters(tracker_rate=120.0))
        assert reasons(tracker, [hand_motion(0), hand_motion(3)]) == [None, RefusalReason.GAP]

    def test_one_outlier_costs_one_pose(self):
        bodies = [hand_motion(i) for i in range(40)]
        bodies[20] = moved(bodies[20], [0.05, 0.0, 0.0])
        found = reasons(ScopeTracker(AT_BODY), bodies)
        assert found[20] is RefusalReason.JUMP
        assert found.count(None) == 39

    def test_a_turn_by_half_a_circle_is_a_jump(self):
        bodies = [hand_motion(i) for i in range(40)]
        flip = Rotation.from_euler("z", 180, degrees=True)
        for i in range(20, 40):
            turned = flip * Rotation.from_quat(bodies[i].quaternion_xyzw)
            bodies[i] = replace(bodies[i], quaternion_xyzw=turned.as_quat())
        found = reasons(ScopeTracker(AT_BODY), bodies)
        assert found[20:] == [RefusalReason.JUMP] * 20

    def test_a_body_that_stays_away_is_refused_until_the_hold_is_over(self):
        bodies = [
            hand_motion(i) if i < 100 else moved(hand_motion(i), [0.3, 0.0, 0.0]) for i in range(100 + 240)
        ]
        found = reasons(ScopeTracker(AT_BODY, validity=ValidityParameters(jump_hold=1.0)), bodies)
        assert found[100:220] == [RefusalReason.JUMP] * 120
        assert set(found[221:]) == {None}
        assert set(reasons(ScopeTracker(AT_BODY), bodies)[100:]) == {RefusalReason.JUMP}

    def test_a_second_jump_elsewhere_is_no_return(self):
        bodies = [hand_motion(i) for i in range(240)]
        bodies[100:] = [moved(body, [0.3, 0.0, 0.0]) for body in bodies[100:]]
        bodies[200:] = [moved(body, [0.0, 0.3, 0.0]) for body in bodies[200:]]
        assert set(reasons(ScopeTracker(AT_BODY), bodies)[100:]) == {RefusalReason.JUMP}

    def test_a_body_that_comes_back_is_taken_at_once(self):
        bodies = [hand_motion(i) for i in range(240)]
        bodies[100:200] = [moved(body, [0.3, 0.0, 0.0]) for body in bodies[100:200]]
        found = reasons(ScopeTracker(AT_BODY), bodies)
        assert found[100:200] == [RefusalReason.JUMP] * 100
        assert set(found[200:]) == {None}

    def test_hostile_streams_raise_nothing_and_pass_nothing_malformed(self):
        rng = np.random.default_rng(3)
        tracker = ScopeTracker(AT_BODY)
        values = np.array([nan, inf, -inf, 0.0, 1e308, 1e-308, 1.0, -1.0])
        for _ in range(5000):
            body = BodyPose(
                stamp_ns=int(rng.integers(-10, 2**62)),
                position=rng.choice(values, 3),
                quaternion_xyzw=rng.choice(values, 4),
                tracking_valid=bool(rng.random() < 0.9),
                mean_error=float(rng.choice(values)),
            )
            result = tracker.update(body)
            if isinstance(result, LensPose):
                assert np.isfinite(result.matrix()).all()
                assert body.tracking_valid


class TestParameters:
    @pytest.mark.parametrize(
        ("values", "message"),
        [
            ({"oblique_angle": 30.0}, r"oblique_angle must lie in \[-1.5708, 1.5708\], not 30"),
            ({"translation_error": -1e-3}, "translation_error must lie in"),
            ({"rotation_error": nan}, "rotation_error must lie in"),
            (
                {"body_to_shaft_translation": (0.0, 0.0)},
                "body_to_shaft_translation must have 3 numbers, not 2",
            ),
            ({"body_to_shaft_quaternion_xyzw": (0.0,) * 4}, "must be of length 1"),
            ({"translation_error_at": "tip"}, "must be one of lens, body, not 'tip'"),
        ],
    )
    def test_what_breaks_a_rule_is_refused_with_the_rule(self, values, message):
        with pytest.raises(PerceptionError, match=message):
            TrackingParameters(**values)

    def test_limits(self):
        with pytest.raises(PerceptionError, match="max_speed must lie in"):
            ValidityParameters(max_speed=0.0)
        assert ValidityParameters(tracker_rate=nan, jump_hold=inf).jump_hold == inf


def test_messages_carry_the_pose_there_and_back():
    body = hand_motion(4)
    lens = ScopeTracker(TrackingParameters(body_to_shaft_translation=(0.1, 0.0, 0.2))).update(body)
    message = fill_lens_pose(
        SimpleNamespace(header=header(0, ""), pose=SimpleNamespace(pose=pose(np.zeros(3)), covariance=None)),
        lens,
    )
    read = body_pose_from_message(SimpleNamespace(header=message.header, pose=message.pose.pose), "lens")
    assert read.stamp_ns == body.stamp_ns
    assert message.header.frame_id == "world"
    np.testing.assert_array_equal(read.position, lens.position)
    np.testing.assert_array_equal(read.quaternion_xyzw, lens.quaternion_xyzw)
    np.testing.assert_array_equal(np.reshape(message.pose.covariance, (6, 6)), lens.covariance)
    blank = pose(np.zeros(3))
    frame = FramePose(lens.stamp_ns, "scope_body", lens.child_frame_id, lens.position, lens.quaternion_xyzw)
    transform = fill_transform(
        SimpleNamespace(
            header=header(0, ""),
            child_frame_id="",
            transform=SimpleNamespace(translation=blank.position, rotation=blank.orientation),
        ),
        frame,
    )
    assert (transform.header.frame_id, transform.child_frame_id) == ("scope_body", "arthroscope_optical")
    assert transform.transform.translation.x == lens.position[0]
    assert transform.transform.rotation.w == lens.quaternion_xyzw[3]


def test_angles_between_poses_are_exact_near_zero_and_near_a_half_turn():
    from knee_gap_perception.scope_pose.pose_validity import distance_and_angle

    start = hand_motion(0)
    for angle in (1e-9, 1e-4, 1.0, pi - 1e-6):
        turned = Rotation.from_rotvec([0.0, angle, 0.0]) * Rotation.from_quat(start.quaternion_xyzw)
        for sign in (1.0, -1.0):
            end = replace(start, quaternion_xyzw=sign * turned.as_quat())
            assert distance_and_angle(start, end)[1] == pytest.approx(angle, rel=1e-6)


def test_tracker_that_does_not_know_where_the_lens_sits_is_refused():
    with pytest.raises(PerceptionError, match="where the lens sits on the tracked body is not known"):
        ScopeTracker()
