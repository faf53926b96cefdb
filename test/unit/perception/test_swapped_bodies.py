"""Bodies whose labels the tracker swaps."""

from dataclasses import replace

import numpy as np
import pytest
from tracked_hand import AT_BODY, hand_motion, moved

from knee_gap_core.values.poses import LensPose
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker


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
