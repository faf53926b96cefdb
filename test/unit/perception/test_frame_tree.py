"""The frames on /tf end where scope_pose is, whatever the tracker follows."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.poses import BodyPose, FramePose, LensPose, rigid_transform
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_perception.calibration.calibration import Calibration, LensOnBody, Oblique
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.frame_tree import FrameParameters, FrameTree
from knee_gap_perception.scope_pose.pose_validity import Refusal
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis

START_NS, PERIOD_NS = 10**18, 8_333_333
SCOPE = TrackingParameters(body_to_shaft_translation=(0.01, -0.02, 0.2))


def body(index: int, name: str = "scope", place: float = 0.3) -> BodyPose:
    t = index * 0.008
    turn = Rotation.from_rotvec([0.3, 0.1 * t, place])
    return BodyPose(START_NS + index * PERIOD_NS, np.array([place, 0.02 * t, 0.1]), turn.as_quat(), name)


def chain(frames: list[FramePose], *names: str) -> np.ndarray:
    """The transform from the first of the frames to the last, by the frames between."""
    T = np.eye(4)
    for parent, child in itertools.pairwise(names):
        (frame,) = (one for one in frames if (one.frame_id, one.child_frame_id) == (parent, child))
        T = T @ rigid_transform(frame.position, frame.quaternion_xyzw)
    return T


def test_the_tree_goes_from_the_world_by_the_tracked_body_to_the_lens() -> None:
    tracker = ScopeTracker(SCOPE)
    lenses = tracker.take(body(3))
    frames = FrameTree(FrameParameters(), tracker).frames(lenses)
    assert len(frames) == 2
    assert {frame.stamp_ns for frame in frames} == {body(3).stamp_ns}
    tracked = rigid_transform(body(3).position, body(3).quaternion_xyzw)
    np.testing.assert_allclose(chain(frames, "world", "scope_body"), tracked, atol=1e-12)
    whole = chain(frames, "world", "scope_body", "arthroscope_optical")
    assert isinstance(lenses[0], LensPose)
    np.testing.assert_allclose(whole, lenses[0].matrix(), atol=1e-12)


def test_a_scope_that_is_turned_in_its_head_has_its_lens_where_the_pose_says() -> None:
    lens = LensOnBody(
        np.array([0.02, 0.0, 0.2]), Rotation.from_rotvec([0.5, 0.0, 0.1]).as_quat(), np.eye(6) * 1e-9,
        Mount.CAMERA_HEAD, 1e-4, 1e-4, 0.2, 20,
    )  # fmt: skip
    axis = ShaftAxis(np.array([0.0, 0.0, 1.0]), np.array([0.01, 0.0, 0.0]))
    head_scope = rigid(np.eye(3), [0.0, 0.03, 0.1])
    calibration = Calibration(
        1280, 720, lens=lens, oblique=Oblique(0.4, axis, 1e-4, 1e-5, T_head_scope=head_scope)
    )
    tracker = ScopeTracker(TrackingParameters(scope_rotation_body="shaft"), None, calibration)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7])
    about = rigid(turn.as_matrix(), axis.point - turn.apply(axis.point))
    head = body(1)
    T = rigid_transform(head.position, head.quaternion_xyzw) @ about @ head_scope
    second = BodyPose(head.stamp_ns, T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(), "shaft")
    lenses = tracker.take(head, [second])
    assert isinstance(lenses[0], LensPose)
    assert lenses[0].scope_rotation == pytest.approx(0.7)
    frames = FrameTree(FrameParameters(), tracker).frames(lenses)
    np.testing.assert_allclose(
        chain(frames, "world", "scope_body"), rigid_transform(head.position, head.quaternion_xyzw), atol=1e-9
    )
    whole = chain(frames, "world", "scope_body", "arthroscope_optical")
    np.testing.assert_allclose(whole, lenses[0].matrix(), atol=1e-12)


def test_with_a_reference_body_the_scope_hangs_below_it() -> None:
    tracker = ScopeTracker(replace(SCOPE, reference_body="tibia"))
    tree = FrameTree(FrameParameters(body_frame_id="head"), tracker)
    leg = body(2, "tibia", -0.2)
    lenses = tracker.take(body(2), [leg])
    frames = tree.frames(lenses)
    scope = rigid_transform(body(2).position, body(2).quaternion_xyzw)
    np.testing.assert_allclose(chain(frames, "world", "tibia", "head"), scope, atol=1e-12)
    # The same frame of the tracker is not reported twice, and a rejected pose has no frames.
    assert [frame.child_frame_id for frame in tree.frames(lenses)] == ["head", "arthroscope_optical"]
    rejected = tracker.take(body(3))
    assert isinstance(rejected[0], Refusal)
    assert tree.frames(rejected) == []


@pytest.mark.parametrize(
    ("name", "scope"),
    [
        ("world", SCOPE),
        ("arthroscope_optical", SCOPE),
        ("tibia", replace(SCOPE, reference_body="tibia")),
        ("", SCOPE),
        ("head", replace(SCOPE, frame_id="arthroscope_optical")),
    ],
    ids=["the tracker's", "the lens's", "the leg's", "none", "world is the lens"],
)
def test_frames_of_one_name_are_refused(name: str, scope: TrackingParameters) -> None:
    with pytest.raises(PerceptionError, match="need names of their own"):
        FrameTree(FrameParameters(body_frame_id=name), ScopeTracker(scope))
