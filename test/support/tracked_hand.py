"""Tracked bodies of a scope in a moving hand, and what a tracker of it answers."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters

PERIOD_NS = 8_333_333
START_NS = 1_700_000_000_000_000_000

# A lens in the middle of its tracked body.
AT_BODY = TrackingParameters(body_to_shaft_translation=(0.0, 0.0, 0.0))


def hand_motion(
    index: int, *, name: str = "scope", centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> BodyPose:
    """A body that sways as in a hand: 30 mm/s and 0.3 rad/s at most."""
    t = index * PERIOD_NS / 1e9
    turn = Rotation.from_rotvec([0.1 * np.sin(3 * t), 0.1 * np.cos(2 * t), 0.2])
    return BodyPose(
        stamp_ns=START_NS + index * PERIOD_NS,
        position=np.array(centre) + 0.01 * np.array([np.sin(3 * t), np.cos(2 * t), np.sin(t)]),
        quaternion_xyzw=turn.as_quat(),
        name=name,
    )


def moved(body: BodyPose, shift: Sequence[float]) -> BodyPose:
    """The body elsewhere by a shift (3,) [m]."""
    return replace(body, position=body.position + np.array(shift))


def reasons(tracker: ScopeTracker, bodies: Iterable[BodyPose]) -> list[RefusalReason | None]:
    """Reason of each refusal in turn, None where a pose of the lens came out."""
    results = [tracker.update(body) for body in bodies]
    return [result.reason if isinstance(result, Refusal) else None for result in results]
