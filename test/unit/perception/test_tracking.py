from dataclasses import replace
from math import inf, nan, pi, radians
from types import SimpleNamespace

import numpy as np
import pytest
from plain_messages import header, pose
from scipy.spatial.transform import Rotation

from knee_gap_core.values.pose_messages import body_pose_from_message, fill_lens_pose, fill_transform
from knee_gap_core.values.poses import BodyPose, FramePose, LensPose, rigid_transform
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker, TrackingParameters

PERIOD_NS = 8_333_333
START_NS = 1_700_000_000_000_000_000

# A lens in the middle of its tracked body.
AT_BODY = TrackingParameters(body_to_shaft_translation=(0.0, 0.0, 0.0))


def hand_motion(index, *, name="scope", centre=(0.0, 0.0, 0.0)):
    """A body that sways as in a hand: 30 mm/s and 0.3 rad/s at most."""
    t = index * PERIOD_NS / 1e9
    turn = Rotation.from_rotvec([0.1 * np.sin(3 * t), 0.1 * np.cos(2 * t), 0.2])
    return BodyPose(
        stamp_ns=START_NS + index * PERIOD_NS,
        position=np.array(centre) + 0.01 * np.array([np.sin(3 * t), np.cos(2 * t), np.sin(t)]),
        quaternion_xyzw=turn.as_quat(),
        name=name,
    )


def moved(body, shift):
    return replace(body, position=body.position + np.array(shift))


def reasons(tracker, bodies):
    """Reason of each refusal in turn, None where a pose of the lens came out."""
    results = [tracker.update(body) for body in bodies]
    return [result.reason if isinstance(result, Refusal) else None for result in results]


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


class TestSwappedBodies:
    def run(self, *, swapped, missing=()):
        tracker = ScopeTracker(AT_BODY)
        found = []
        for i in range(300):
            scope, leg = hand_motion(i), hand_motion(i + 77, name="leg", centre=(0.2, 0.1, 0.0))
            leg = replace(leg, stamp_ns=scope.stamp_ns)
            if i in missing:
                continue
            if i in swapped:
                scope, leg = replace(leg, name="scope"), replace(scope, name="leg")
            result = tracker.update(scope, [leg])
            found.append(result.reason if isinstance(result, Refusal) else None)
        return found

    def test_nothing_is_published_while_two_labels_are_swapped(self):
        found = self.run(swapped=range(100, 200))
        assert found[100:200] == [RefusalReason.SWAPPED] * 100
        assert found[200] is RefusalReason.GAP
        assert set(found[:100] + found[201:]) == {None}

    @pytest.mark.parametrize("hidden", [range(180, 230), range(90, 110), range(90, 230)])
    def test_a_swap_that_begins_or_ends_behind_an_occlusion_does_not_turn_the_names_round(self, hidden):
        tracker, wrong, accepted = ScopeTracker(AT_BODY), 0, set()
        for i in range(400):
            scope, leg = hand_motion(i), hand_motion(i + 77, name="leg", centre=(0.2, 0.1, 0.0))
            leg = replace(leg, stamp_ns=scope.stamp_ns)
            true = scope.position
            scope = replace(scope, tracking_valid=i not in hidden)
            if 100 <= i < 200:
                scope, leg = replace(leg, name="scope"), replace(scope, name="leg")
            result = tracker.update(scope, [leg])
            if isinstance(result, LensPose):
                accepted.add(i)
                wrong += bool(np.linalg.norm(scope.position - true) > 1e-3)
        assert wrong == 0
        assert set(range(240, 400)) <= accepted

    def test_a_jump_is_not_confirmed_by_the_time_in_which_labels_are_in_doubt(self):
        """Jump and swap at once turn the names round; then the labels swap again where nothing is seen."""
        tracker, wrong = ScopeTracker(AT_BODY, validity=ValidityParameters(jump_hold=1.0)), 0
        for i in [*range(260), *range(300, 340)]:
            scope, leg = hand_motion(i), hand_motion(i, name="leg", centre=(0.25, 0.1, 0.0))
            true = scope.position
            if 100 <= i < 160:
                scope = moved(scope, [0.06, 0.0, 0.02])
            if 100 <= i < 160 or i >= 300:
                scope, leg = replace(leg, name="scope"), replace(scope, name="leg")
            if isinstance(tracker.update(scope, [leg]), LensPose):
                wrong += bool(np.linalg.norm(scope.position - true) > 1e-3)
        assert wrong == 0

    def test_labels_that_stay_are_believed_when_the_hold_is_over(self):
        """As after a start with swapped labels, which nothing can tell."""
        tracker, found = ScopeTracker(AT_BODY, validity=ValidityParameters(jump_hold=1.0)), []
        for i in range(400):
            scope, leg = hand_motion(i), hand_motion(i, name="leg", centre=(0.2, 0.1, 0.0))
            if i < 100:
                scope, leg = replace(leg, name="scope"), replace(scope, name="leg")
            result = tracker.update(scope, [leg])
            found.append(result.reason if isinstance(result, Refusal) else None)
        assert set(found[100:220]) == {RefusalReason.SWAPPED}
        assert set(found[222:]) == {None}

    def test_labels_that_go_round_among_three_bodies(self):
        tracker, names, accepted = ScopeTracker(AT_BODY), ["scope", "leg", "probe"], []
        for i in range(300):
            bodies = [hand_motion(i, centre=(0.15 * k, 0.05 * k, 0.0)) for k in range(3)]
            turned = names[1:] + names[:1] if 100 <= i < 200 else names
            frame = {name: replace(body, name=name) for name, body in zip(turned, bodies, strict=True)}
            scope = frame.pop("scope")
            accepted.append(isinstance(tracker.update(scope, frame.values()), LensPose))
        assert not any(accepted[100:200])
        assert all(accepted[:100] + accepted[201:])

    def test_a_scope_that_moved_far_unseen_is_held_like_one_that_jumped_and_is_no_leg(self):
        """Nothing tells an unseen motion from an unseen jump: neither is believed before the hold is over."""
        tracker, found = ScopeTracker(AT_BODY, validity=ValidityParameters(jump_hold=1.0)), []
        for i in range(600):
            leg = replace(
                hand_motion(0, name="leg", centre=(0.1, 0.0, 0.0)), stamp_ns=hand_motion(i).stamp_ns
            )
            scope = hand_motion(i) if i < 100 else moved(hand_motion(i), [0.08, 0.0, 0.0])
            scope = replace(scope, tracking_valid=not 100 <= i < 400)
            found.append(tracker.update(scope, [leg]))
        assert {r.reason for r in found[400:520]} == {RefusalReason.JUMP}
        assert all(isinstance(result, LensPose) for result in found[521:])

    def test_a_scope_that_moved_a_little_unseen_is_taken_at_once(self):
        tracker, found = ScopeTracker(AT_BODY), []
        for i in range(300):
            scope = hand_motion(i) if i < 100 else moved(hand_motion(i), [0.01, 0.0, 0.0])
            found.append(tracker.update(replace(scope, tracking_valid=not 100 <= i < 200)))
        assert all(isinstance(result, LensPose) for result in found[201:])

    def test_a_jump_behind_an_occlusion_is_no_motion(self):
        tracker, found = ScopeTracker(AT_BODY), []
        for i in range(300):
            scope = moved(hand_motion(i), [0.06, 0.0, 0.02]) if 150 <= i < 250 else hand_motion(i)
            found.append(tracker.update(replace(scope, tracking_valid=not 100 <= i < 160)))
        assert not any(isinstance(result, LensPose) for result in found[160:250])
        assert all(isinstance(result, LensPose) for result in found[251:])

    def test_labels_swapped_in_a_drop_out_are_seen(self):
        # 60 frames are half a second: at 1 m/s either place could have been reached.
        found = self.run(swapped=range(160, 300), missing=range(100, 160))
        assert set(found[100:]) == {RefusalReason.SWAPPED}


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
