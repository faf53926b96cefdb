"""The notch through a stream of images that a gap crosses, and the lens poses that rest on it."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.poses import BodyPose, LensPose, rigid_transform
from knee_gap_core.values.rigid_transforms import to_vector
from knee_gap_core.values.stamps import set_stamp
from knee_gap_perception.calibration.calibration import Calibration, LensOnBody, Oblique
from knee_gap_perception.calibration.calibration_file import load_calibration, save_calibration
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.image.field_of_view import FieldOfView
from knee_gap_perception.messages_tracking import fill_scope_notch, fill_scope_rotation, notch_from_message
from knee_gap_perception.scope_pose.pose_validity import Refusal, RefusalReason
from knee_gap_perception.scope_pose.scope_tracker import NO_NOTCH_YET, ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.scope_rotation.notch import Notch, NotchShape, common_shape, find_notch, notches_of
from knee_gap_perception.scope_rotation.notch_border import STEP, STEPS, Border
from knee_gap_perception.scope_rotation.notch_tracker import (
    FAR_AWAY,
    NO_FIELD,
    NO_NOTCH,
    NOT_SURE,
    SEVERAL,
    NotchFollower,
    NotchObservation,
)
from knee_gap_perception.scope_rotation.rotated_poses import NO_POSES
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis
from knee_gap_uncertainty.estimation.messages import rotation_from_message

SHAPE = NotchShape(0.047, 0.0597)
HEIGHT, WIDTH = 360, 640
CENTRE, RADIUS = (322.5, 179.0), 172.0
FIELD = FieldOfView(CENTRE, RADIUS, (0.0, 0.0, WIDTH - 1.0, HEIGHT - 1.0))
FRAME_NS = 33_333_333
START_NS = 10**18

_ROWS, _COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
_X, _Y = _COLUMNS - CENTRE[0], _ROWS - CENTRE[1]
_FROM_CENTRE, _ANGLE = np.hypot(_X, _Y) / RADIUS, np.arctan2(_Y, _X)


def picture(
    *notches: float, gap: tuple[float, float] | None = None, seed: int = 0, depth: float = 0.055
) -> npt.NDArray[np.uint8]:
    """A lit field with notches at angles [rad], crossed by a dark gap between two rows [radii]."""
    rng = np.random.default_rng(seed)
    light = 130 + 50 * np.cos(3 * _ANGLE + 1) * _FROM_CENTRE
    if gap is not None:
        wavy = 0.03 * np.sin(9 * _X / RADIUS)
        inside = (gap[0] + wavy < _Y / RADIUS) & (gap[1] - wavy > _Y / RADIUS)
        light = np.where(inside, 9.0, light)
    reach = np.ones_like(_FROM_CENTRE)
    for notch in notches:
        away = np.abs((_ANGLE - notch + np.pi) % (2 * np.pi) - np.pi)
        reach -= depth * np.clip(1 - away / np.radians(2.6), 0, 1)
    share = np.clip((reach - _FROM_CENTRE) * RADIUS + 0.5, 0, 1)
    noisy = light * share + 3 * rng.standard_normal(light.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def stamp(index: int) -> int:
    return START_NS + index * FRAME_NS


def wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def test_a_notch_that_turns_through_the_gap_is_right_wherever_it_is_told() -> None:
    follower, reported, hidden = NotchFollower(SHAPE), [], 0
    for index in range(120):
        angle = -2.6 + 0.05 * index
        observation = follower.look(stamp(index), picture(angle, gap=(-0.25, 0.2), seed=index))
        row = np.sin(angle)
        hidden += bool(-0.2 < row < 0.15 and not observation.seen)
        if observation.seen:
            reported.append(np.degrees(wrapped(observation.angle - angle)))
        else:
            assert np.isnan(observation.angle)
    # Where the gap reaches the border it does not show, and nothing is reported.
    assert hidden > 5
    assert len(reported) > 85
    assert np.abs(reported).max() < 0.5
    assert np.sqrt(np.mean(np.square(reported))) < 0.15


def test_a_gap_at_the_border_is_no_notch() -> None:
    """Gaps that reach the border anywhere, as narrow as a notch and far wider."""
    for index in range(60):
        follower = NotchFollower(SHAPE)
        middle, width = np.linspace(-0.8, 0.8, 60)[index], (0.06, 0.12, 0.2, 0.4)[index % 4]
        for image in range(4):
            edges = (middle - width / 2 + 0.002 * image, middle + width / 2)
            observation = follower.look(stamp(image), picture(gap=edges, seed=4 * index + image))
            assert not observation.seen
            assert observation.reason in (NO_NOTCH, NO_FIELD, NOT_SURE, SEVERAL)


def test_a_first_sight_counts_when_it_is_confirmed() -> None:
    follower = NotchFollower(SHAPE)
    reasons = [follower.look(stamp(k), picture(0.4, seed=k)).reason for k in range(4)]
    assert reasons == [NOT_SURE, NOT_SURE, "", ""]


def test_something_alike_elsewhere_is_not_taken_for_it() -> None:
    follower = NotchFollower(SHAPE)
    for k in range(3):
        follower.look(stamp(k), picture(0.4, seed=k))
    # The notch hidden, and something of its shape far from where it can have turned to.
    assert follower.look(stamp(3), picture(2.0)).reason == FAR_AWAY
    assert follower.look(stamp(4), picture(0.4, 2.0)).seen
    # Two within reach of it: nothing is guessed.
    assert follower.look(stamp(5), picture(0.3, 0.55)).reason == SEVERAL
    assert follower.look(stamp(6), picture(0.42)).seen
    # After half a second unseen it may be anywhere, and has to be confirmed again.
    assert follower.look(stamp(40), picture(2.0)).reason == NOT_SURE


def test_a_notch_of_another_shape_is_not_this_scopes() -> None:
    assert find_notch(picture(0.4, depth=0.1), FIELD) is not None
    follower = NotchFollower(SHAPE)
    assert {follower.look(stamp(k), picture(0.4, depth=0.1, seed=k)).reason for k in range(4)} == {NO_NOTCH}


@pytest.mark.parametrize("depth", [0.05, 0.11, 0.15, -0.05, -0.10, -0.15])
@pytest.mark.parametrize("angle", [0.4, 2.9, -1.0])
def test_a_notch_is_found_from_far_inside_to_far_outside_the_disc(depth: float, angle: float) -> None:
    """Real ones point outwards to 1.11 of the radius."""
    notch = find_notch(picture(angle, depth=depth), FIELD)
    assert notch is not None
    assert np.degrees(abs(notch.angle - angle)) < 0.15
    assert notch.depth == pytest.approx(depth, rel=0.2)


def test_a_notch_that_the_frame_cuts_is_not_guessed() -> None:
    assert find_notch(picture(1.3, depth=-0.1), FIELD) is None


def test_a_notch_beside_a_border_that_bulges_is_the_same_notch() -> None:
    """A disc that is not quite round leaves its circle by more than the least depth of a notch."""
    angle = np.arange(STEPS) * STEP
    notch = 0.1 * np.clip(1.0 - np.abs(angle - 2.0) / np.radians(3.3), 0.0, 1.0)
    bulge = 0.014 * np.exp(-(((angle - 2.0) / 0.25) ** 2))
    for side in (1.0, -1.0):
        border = Border(side * (notch + bulge), np.ones(STEPS, bool), CENTRE, RADIUS)
        (found,) = notches_of(border)
        assert np.degrees(abs(found.angle - 2.0)) < 0.2
        assert side * found.depth == pytest.approx(0.114, abs=0.005)


def test_a_dark_or_full_picture_has_no_border() -> None:
    follower = NotchFollower(SHAPE)
    assert follower.look(stamp(0), np.zeros((HEIGHT, WIDTH, 3), np.uint8)).reason == NO_FIELD
    assert follower.look(stamp(1), np.full((HEIGHT, WIDTH, 3), 120, np.uint8)).reason == NO_FIELD


def test_the_shape_is_the_median_of_what_was_seen() -> None:
    seen = [None, Notch(0.1, 0.04, 0.05), Notch(0.2, 0.05, 0.06), Notch(0.3, 0.09, 0.07)]
    assert common_shape(seen) == NotchShape(0.05, 0.06)
    assert common_shape([None]) is None


CAMERA = Intrinsics(
    WIDTH, HEIGHT, "equidistant", (220.0, 0.0, 322.0, 0.0, 220.0, 179.0, 0.0, 0.0, 1.0), (0.0,) * 4,
    np.eye(8) * 1e-4, 0.1, 0.1, 1.0, 20, 900,
)  # fmt: skip
AXIS = ShaftAxis(np.array([0.0, 0.6, 0.8]), np.array([0.003, -0.012, 0.1]))
LENS = LensOnBody(
    np.array([0.0035, -0.012, 0.2031]), np.array([0.24, -0.02, -0.03, np.sqrt(1 - 0.0589)]),
    np.diag([1e-8] * 3 + [4e-8] * 3), Mount.CAMERA_HEAD, 7e-5, 3.7e-5, 0.4, 48,
)  # fmt: skip
SCOPE = Calibration(
    WIDTH, HEIGHT, CAMERA, LENS, Oblique(0.3, AXIS, 5e-4, 4e-5, notch_shape=SHAPE)
)  # fmt: skip


def head(time: float) -> Any:
    return rigid_transform([0.1 + 0.02 * time, 0.2, 0.3], [0.1 * time, 0.0, 0.0, np.sqrt(1 - 0.01 * time**2)])


def body(time: float) -> BodyPose:
    half = np.arcsin(0.1 * time)
    quaternion = np.array([np.sin(half), 0.0, 0.0, np.cos(half)])
    return BodyPose(START_NS + round(time * 1e9), head(time)[:3, 3], quaternion, "scope")


def observation(time: float, turn: float, reason: str = "") -> NotchObservation:
    unknown = float("nan")
    stamp_ns = START_NS + round(time * 1e9)
    if reason:
        return NotchObservation(stamp_ns, unknown, unknown, reason)
    return NotchObservation(stamp_ns, wrapped(0.3 + turn), 1e-3)


def test_there_is_one_pose_an_image_turned_as_its_notch_says() -> None:
    tracker, found = ScopeTracker(calibration=SCOPE, by_notch=True), []
    assert tracker.notch_flaw == NO_NOTCH_YET
    for k in range(60):
        time = k / 120
        if k % 4 == 2:
            # It comes before the tracked pose that follows it, and again in the other order.
            found += tracker.take_notch(observation(time - 0.004, 0.5 * (time - 0.004)))
        found += tracker.take(body(time))
    poses = [pose for pose in found if isinstance(pose, LensPose)]
    assert len(poses) == len(found) == 15
    for pose in poses:
        time = (pose.stamp_ns - START_NS) / 1e9
        expected = head(time) @ SCOPE.body_to_lens(0.5 * time)
        error = to_vector(np.linalg.inv(expected) @ pose.matrix())
        assert np.linalg.norm(error[3:]) < 2e-6
        assert np.linalg.norm(error[:3]) < 2e-5
        message = fill_scope_rotation(blank("knee_gap_msgs/msg/ScopeRotation"), pose)
        reported = rotation_from_message(message)
        assert reported.stamp_ns == pose.stamp_ns
        assert reported.turn == pytest.approx(0.5 * time)
        assert message.header.frame_id == pose.child_frame_id
    assert tracker.follows_rotation
    assert tracker.notch_flaw == ""
    assert tracker.accepted_count == 15


def test_an_image_without_its_notch_or_without_poses_has_no_pose() -> None:
    tracker = ScopeTracker(calibration=SCOPE, by_notch=True)
    for k in range(12):
        assert tracker.take(body(k / 120)) == []
    (refused,) = tracker.take_notch(observation(0.05, 0.1, NO_NOTCH))
    assert isinstance(refused, Refusal)
    assert (refused.reason, refused.detail) == (RefusalReason.NO_TURN, NO_NOTCH)
    assert tracker.notch_flaw == NO_NOTCH
    # The tracker is away around the next image.
    assert tracker.take_notch(observation(0.2, 0.1)) == []
    late = [tracker.take(body(k / 120)) for k in range(40, 44)]
    (refused,) = [
        one for reported in late for one in reported if isinstance(one, Refusal) and one.detail == NO_POSES
    ]
    assert tracker.accepted_count == 0


def test_a_turn_that_is_not_known_well_is_felt_in_the_covariance() -> None:
    """Against the spread of poses at turns drawn with that error."""
    rng = np.random.default_rng(5)
    tracker = ScopeTracker(calibration=SCOPE, by_notch=True)
    tracker.take(body(0.1))

    def at(turn: float, error: float) -> LensPose:
        (pose,) = tracker.take_notch(NotchObservation(body(0.1).stamp_ns, wrapped(0.3 + turn), error))
        assert isinstance(pose, LensPose)
        return pose

    sure, unsure = at(0.6, 0.0), at(0.6, 0.01)
    turned = [at(0.6 + 0.01 * float(rng.standard_normal()), 0.0) for _ in range(4000)]
    moved = np.array([pose.position - sure.position for pose in turned])
    spread = np.cov(moved.T)
    np.testing.assert_allclose(
        (unsure.covariance - sure.covariance)[:3, :3], spread, atol=0.06 * np.trace(spread)
    )
    rotations = np.array([to_vector(pose.matrix() @ np.linalg.inv(sure.matrix()))[:3] for pose in turned])
    spread = np.cov(rotations.T)
    np.testing.assert_allclose(
        (unsure.covariance - sure.covariance)[3:, 3:], spread, atol=0.06 * np.trace(spread)
    )


@pytest.mark.parametrize(
    ("parameters", "calibration", "words"),
    [
        ({}, None, "needs a calibration_file of calibrate oblique"),
        ({"scope_rotation_body": "post"}, SCOPE, "leave one of them out"),
        ({}, replace(SCOPE, oblique=None), "does not know the notch"),
        ({}, replace(SCOPE, oblique=Oblique(0.3, AXIS, 5e-4, 4e-5)), "does not know the notch"),
        (
            {},
            replace(SCOPE, oblique=Oblique(0.3, None, np.nan, np.nan, notch_shape=SHAPE)),
            "no rotation axis of the scope",
        ),
    ],
)
def test_a_notch_that_cannot_tell_the_turn_is_refused_at_the_start(
    parameters: dict[str, Any], calibration: Calibration | None, words: str
) -> None:
    with pytest.raises(PerceptionError, match=words):
        ScopeTracker(TrackingParameters(**parameters), calibration=calibration, by_notch=True)


def image(index: int, pixels: npt.NDArray[np.uint8]) -> Any:
    message = blank("sensor_msgs/msg/Image")
    set_stamp(message.header, stamp(index))
    message.height, message.width, message.encoding = *pixels.shape[:2], "bgr8"
    message.step, message.data = 3 * pixels.shape[1], pixels.ravel()
    return message


def test_the_stream_says_at_once_where_the_notch_is_and_waits_for_its_pose_only() -> None:
    stream = EdgeStream(calibration=SCOPE, by_notch=True)
    observations = [stream.on_image(image(k, picture(0.4, seed=k)), stamp(k)) for k in range(3)]
    assert [one.seen for one in observations if one is not None] == [False, False, True]
    assert stream.counts["the notch is seen"] == 1
    small = stream.on_image(image(3, picture(0.4)[:100, :200]), stamp(3))
    assert small is not None
    assert "calibrate again at this size" in small.reason
    assert EdgeStream(calibration=SCOPE).on_image(image(0, picture(0.4))) is None
    with pytest.raises(PerceptionError, match="needs a calibration_file"):
        EdgeStream(by_notch=True)


def test_a_sight_survives_its_message_and_numbers_that_are_none_are_no_sight() -> None:
    message = fill_scope_notch(blank("knee_gap_msgs/msg/ScopeNotch"), observation(1.0, 0.2), "lens")
    assert notch_from_message(message) == observation(1.0, 0.2)
    message.angle = float("inf")
    assert "must be finite" in notch_from_message(message).reason
    unseen = fill_scope_notch(blank("knee_gap_msgs/msg/ScopeNotch"), observation(1.0, 0.2, NO_NOTCH), "lens")
    assert notch_from_message(unseen).reason == NO_NOTCH
    assert np.isnan(unseen.angle)


def test_the_shape_is_kept_in_the_file_and_older_files_keep_their_hash(tmp_path: Any) -> None:
    save_calibration(SCOPE, tmp_path / "scope.yaml")
    assert load_calibration(tmp_path / "scope.yaml").require_notch() == SHAPE
    older = replace(SCOPE, oblique=Oblique(0.3, AXIS, 5e-4, 4e-5))
    save_calibration(older, tmp_path / "older.yaml")
    assert "notch_depth" not in (tmp_path / "older.yaml").read_text()
    assert load_calibration(tmp_path / "older.yaml").hash == older.hash
