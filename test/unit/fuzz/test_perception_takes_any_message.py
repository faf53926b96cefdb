"""Whatever comes, the cores of perception answer it with a value, a status or a reason, and never raise."""

import copy
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hostile import SETTINGS, header, hurt, numbers, poses, sequences, stamps, steps_ns
from hypothesis import given
from hypothesis import strategies as st

from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.pose_interpolation import LensPosePredictor
from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import PoseParameters
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.image.encodings import ENCODINGS
from knee_gap_perception.messages import checked_lens_pose, image_from_message
from knee_gap_perception.messages_tracking import notch_from_message
from knee_gap_perception.scope_pose.pose_validity import Refusal
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters
from knee_gap_perception.scope_rotation.rotated_poses import RotatedPoses, Tracked
from knee_gap_perception.trackers.body_source import choose_body
from knee_gap_perception.trackers.pose_topic import PoseTopics

BEGIN_NS = 10**18
K = [229.2, 0.0, 320.0, 0.0, 229.2, 180.0, 0.0, 0.0, 1.0]


@SETTINGS
@given(sequences(lambda stamp: poses(stamp, covered=False), longest=40), st.sampled_from(["", "leg"]))
def test_tracking(messages: list[tuple[int, Any]], reference: str) -> None:
    names = ["scope", reference] if reference else ["scope"]
    source = PoseTopics(names)
    tracker = ScopeTracker(
        TrackingParameters(body_to_shaft_translation=(0.0, 0.01, 0.2), reference_body=reference)
    )
    for index, (_, message) in enumerate(messages):
        source.put(names[index % len(names)], message)
        for frame in source.poll():
            body, others = choose_body(frame, "scope")
            assert body is not None
            for lens in tracker.take(body, others):
                if isinstance(lens, Refusal):
                    assert lens.detail
                    continue
                numbers = [lens.position, lens.quaternion_xyzw, lens.covariance.ravel()]
                assert np.isfinite(np.concatenate(numbers)).all()


@SETTINGS
@given(sequences(poses), st.lists(steps_ns, min_size=5, max_size=5))
def test_prediction_of_the_lens_pose(messages: list[tuple[int, Any]], steps: list[int]) -> None:
    predictor = LensPosePredictor()
    for stamp, message in messages:
        with suppress(PerceptionError):
            predictor.add(checked_lens_pose(message))
        for step in steps:
            lens = predictor.at(stamp + step)
            if lens is not None:
                assert np.isfinite(np.concatenate([lens.position, lens.covariance.ravel()])).all()


@SETTINGS
@given(
    sequences(lambda stamp: poses(stamp, covered=False)),
    st.lists(st.tuples(steps_ns, numbers, numbers, st.booleans()), max_size=12),
)
def test_poses_at_the_notch(bodies: list[tuple[int, Any]], notches: list[Any]) -> None:
    def lens_of(tracked: Tracked, _: float, __: float) -> LensPose:
        body = tracked.body
        return LensPose(body.stamp_ns, "w", body.position, body.quaternion_xyzw, 1e-9 * np.eye(6))

    turned = RotatedPoses(lens_of)
    observations = dict(zip(stamps([step for step, *_ in notches] or [0]), notches, strict=False))
    for index, (stamp, _) in enumerate(bodies):
        quaternion = np.array([0.0, 0.0, 0.0, 1.0])
        turned.add_tracked(Tracked(stamp, BodyPose(stamp, np.zeros(3), quaternion), None))
        if index < len(observations):
            at, (_, angle, error, seen) = list(observations.items())[index]
            message = SimpleNamespace(header=header(at), seen=seen, reason="", angle=angle, angle_error=error)
            turned.add_observation(notch_from_message(message))
        turned.ready()


@SETTINGS
@given(st.data())
def test_camera_models(data: Any) -> None:
    models = st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant", "fisheye", "", "other"])
    count = data.draw(st.sampled_from([0, 4, 5, 8, 12, 3]))
    sizes = st.sampled_from([640, 640, 0, 1, 2**32 - 1])
    message = SimpleNamespace(
        width=data.draw(sizes),
        height=data.draw(sizes),
        distortion_model=data.draw(models),
        d=hurt(data.draw, np.full(count, 0.01), share=2) if count else [],
        k=hurt(data.draw, K, share=2),
    )
    try:
        camera = camera_from_info(message)
    except PerceptionError:
        return  # refused, with its reason
    pixels = np.array([[320.0, 180.0], [0.0, 0.0], [1e6, -1e6], [320.5, 180.5]])
    with np.errstate(all="ignore"):
        bearings = camera.bearings(pixels)
        seen = camera.pixels(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))
    lengths = np.linalg.norm(bearings, axis=-1)
    assert (np.isnan(lengths) | (np.abs(lengths - 1.0) < 1e-9)).all()
    assert seen.shape == (4, 2)


@SETTINGS
@given(
    st.sampled_from([*ENCODINGS, "16UC1", "32FC1", ""]),
    st.sampled_from([0, 1, 5, 64, 2**32 - 1]),
    st.sampled_from([0, 1, 5, 64, 2**32 - 1]),
    st.sampled_from([0, 1, 5, 192, 200, 2**32 - 1]),
    st.integers(0, 64 * 200),
)
def test_images(encoding: str, height: int, width: int, step: int, size: int) -> None:
    message = SimpleNamespace(encoding=encoding, height=height, width=width, step=step, data=bytes(size))
    try:
        image = image_from_message(message)
    except PerceptionError:
        return  # refused, with its reason
    assert image.shape == (height, width, 3)


def small(picture: np.ndarray) -> np.ndarray:
    return cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def pictures(joint: Any) -> list[np.ndarray]:
    """Small images of a lens that moves 0.1 mm an image."""
    places = []
    for k in range(8):
        T = np.eye(4)
        T[0, 3] = 1e-4 * k
        places.append(small(joint.picture(T, k)))
    return places


def image(picture: np.ndarray, stamp_ns: int, excess: int = 0) -> Any:
    height, width = picture.shape[:2]
    return SimpleNamespace(
        header=header(stamp_ns, "arthroscope_optical", excess),
        height=height,
        width=width,
        step=3 * width,
        encoding="bgr8",
        data=picture.tobytes(),
    )


@pytest.fixture(scope="module")
def tracking(pictures: list[np.ndarray]) -> EdgeStream:
    """A stream that follows two points with poses."""
    stream = EdgeStream(poses=PoseParameters(max_pose_wait=0.0))
    info = SimpleNamespace(width=640, height=360, distortion_model="equidistant", d=[0.0] * 4, k=K)
    stream.on_camera_info(info)
    for k in range(3):
        for pose in range(4):
            stamp = BEGIN_NS - (12 - 4 * k - pose) * 8_333_333
            place = SimpleNamespace(x=1e-4 * (k + pose / 4) - 1e-4, y=0.0, z=0.0)
            turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
            covered = SimpleNamespace(
                pose=SimpleNamespace(position=place, orientation=turn),
                covariance=np.diag([4.5e-10] * 3 + [1.6e-9] * 3).ravel(),
            )
            stream.on_lens_pose(SimpleNamespace(header=header(stamp), pose=covered))
        stream.on_image(image(pictures[k], stamp), 0)
        (edges,) = stream.ready(0)
    assert (edges.status, edges.pose_used) == (EdgeStatus.VALID, True)
    return stream


@SETTINGS
@given(st.data())
def test_images_between_poses_of_any_kind(
    tracking: EdgeStream, pictures: list[np.ndarray], data: Any
) -> None:
    stream = copy.deepcopy(tracking)
    count = data.draw(st.integers(1, 4))
    for k, stamp in enumerate(stamps(data.draw(st.lists(steps_ns, min_size=count, max_size=count)))):
        for back in (16_666_667, 8_333_333, 0):
            stream.on_lens_pose(data.draw(poses(stamp - back)))
        excess = data.draw(st.sampled_from([0] * 9 + [4 * 10**9]))
        stream.on_image(image(pictures[3 + k], stamp, excess), 0)
        (edges,) = stream.ready(0)
        assert edges.status is EdgeStatus.VALID or stream.reason
        if edges.status is EdgeStatus.VALID:
            assert np.isfinite(edges.bearings).all()
            assert 0.0 < edges.angular_error < 1.0
    assert stream.overlay() is not None or excess


@pytest.mark.parametrize("tiny", [5e-324, -1e-310, 1e-200])
@pytest.mark.parametrize("model", ["equidistant", "plumb_bob"])
def test_a_coefficient_that_is_nearly_none_changes_nothing(model: str, tiny: float) -> None:
    cameras = []
    for last in (0.0, tiny):
        d = [0.01, 0.002, 0.0, last] if model == "equidistant" else [0.01, 0.002, 0.0, 0.0, last]
        info = SimpleNamespace(width=640, height=360, distortion_model=model, d=d, k=K)
        cameras.append(camera_from_info(info).bearings([[100.0, 50.0], [400.0, 300.0]]))
    np.testing.assert_array_equal(*cameras)
