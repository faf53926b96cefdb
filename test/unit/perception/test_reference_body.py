from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.poses import BodyPose, LensPose, rigid_transform
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason
from knee_gap_perception.scope_pose.reference_body import relative_to
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters

PERIOD_NS = 8_333_333
START_NS = 1_700_000_000_000_000_000
PARAMETERS = TrackingParameters(
    reference_body="tibia", body_to_shaft_translation=(0.0, -0.01, 0.2), translation_error_at="body"
)


def body(name, index, position, turn):
    return BodyPose(START_NS + index * PERIOD_NS, np.array(position), turn.as_quat(), name)


def moved(pose, place, turn):
    """The body after the whole room has been moved."""
    return replace(
        pose,
        position=turn.apply(pose.position) + place,
        quaternion_xyzw=(turn * Rotation.from_quat(pose.quaternion_xyzw)).as_quat(),
    )


def leg_and_scope(index):
    t = index * 0.008
    scope = body("scope", index, [0.3 + 0.01 * t, 0.1, 0.2], Rotation.from_rotvec([0.3, 0.1 * t, 0.2]))
    leg = body("tibia", index, [0.1, 0.02 * t, 0.0], Rotation.from_rotvec([0.0, 0.1 * t, -0.4]))
    return scope, leg


def test_the_pose_in_the_leg_is_that_of_the_matrices():
    scope, leg = leg_and_scope(3)
    in_world = ScopeTracker(replace(PARAMETERS, reference_body="")).update(scope)
    in_leg = ScopeTracker(PARAMETERS).update(scope, [leg])
    assert isinstance(in_leg, LensPose)
    assert in_leg.frame_id == "tibia"
    T_world_leg = rigid_transform(leg.position, leg.quaternion_xyzw)
    np.testing.assert_allclose(in_leg.matrix(), np.linalg.inv(T_world_leg) @ in_world.matrix(), atol=1e-12)


def test_it_does_not_change_when_leg_and_scope_move_together():
    scope, leg = leg_and_scope(5)
    before = ScopeTracker(PARAMETERS).update(scope, [leg])
    place, turn = np.array([1.0, -2.0, 0.5]), Rotation.from_euler("xyz", [40, -20, 100], degrees=True)
    after = ScopeTracker(PARAMETERS).update(moved(scope, place, turn), [moved(leg, place, turn)])
    np.testing.assert_allclose(after.matrix(), before.matrix(), atol=1e-12)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-20)


def test_covariance_is_what_noise_on_both_bodies_does():
    rng = np.random.default_rng(11)
    sigma_place, sigma_turn, runs = 2e-4, 1e-3, 4000
    scope, leg = leg_and_scope(0)
    parameters = replace(
        PARAMETERS, translation_error=sigma_place * 3**0.5, rotation_error=sigma_turn * 3**0.5
    )
    true = ScopeTracker(parameters).update(scope, [leg])
    errors = []
    for _ in range(runs):
        noisy = []
        for pose in (scope, leg):
            turn = Rotation.from_rotvec(rng.normal(0, sigma_turn, 3))
            noisy.append(
                replace(
                    pose,
                    position=pose.position + rng.normal(0, sigma_place, 3),
                    quaternion_xyzw=(turn * Rotation.from_quat(pose.quaternion_xyzw)).as_quat(),
                )
            )
        lens = ScopeTracker(parameters).update(noisy[0], noisy[1:])
        turned = Rotation.from_quat(lens.quaternion_xyzw) * Rotation.from_quat(true.quaternion_xyzw).inv()
        errors.append([*(lens.position - true.position), *turned.as_rotvec()])
    scale = np.sqrt(np.outer(np.diag(true.covariance), np.diag(true.covariance)))
    np.testing.assert_allclose(
        np.cov(np.transpose(errors)) / scale, true.covariance / scale, atol=5 / runs**0.5
    )


def test_a_leg_that_is_known_exactly_adds_nothing():
    scope, leg = leg_and_scope(2)
    lens = ScopeTracker(replace(PARAMETERS, reference_body="")).update(scope)
    relative = relative_to(lens, leg, np.zeros((6, 6)))
    np.testing.assert_allclose(
        np.linalg.eigvalsh(relative.covariance), np.linalg.eigvalsh(lens.covariance), rtol=1e-9
    )


def test_without_a_sound_leg_there_is_no_pose():
    tracker = ScopeTracker(PARAMETERS)
    found = []
    for index in range(60):
        scope, leg = leg_and_scope(index)
        if 20 <= index < 25:
            leg = replace(leg, tracking_valid=False)
        others = [] if 40 <= index < 42 else [leg]
        result = tracker.update(scope, others)
        found.append(result.reason if isinstance(result, Refusal) else None)
    assert found[20:26] == [RefusalReason.NO_REFERENCE] * 6  # five unseen, and the pose that ends the gap
    assert found[40:43] == [RefusalReason.NO_REFERENCE] * 3
    assert set(found[:20] + found[26:40] + found[43:]) == {None}


def test_the_scope_s_own_fault_is_told_first():
    tracker = ScopeTracker(PARAMETERS)
    scope, leg = leg_and_scope(0)
    result = tracker.update(replace(scope, tracking_valid=False), [replace(leg, tracking_valid=False)])
    assert result.reason is RefusalReason.NOT_TRACKED
    assert tracker.validity.counts == {RefusalReason.NOT_TRACKED: 1}
