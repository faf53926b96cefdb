"""Lens poses that break off and come back elsewhere: the stream goes on, with points of a new track."""

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_messages import bgr_image, header, pose

from knee_gap_core.conversions.pose_messages import fill_lens_pose
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_perception.edge_tracking.edge_stream import EdgeStream
from knee_gap_perception.edge_tracking.parameters import PoseParameters
from knee_gap_perception.point_tracking.point_tracker import PointTracker
from knee_gap_perception.scope_pose.pose_validity import RefusalReason, ValidityParameters
from knee_gap_perception.scope_pose.scope_tracker import ScopeTracker
from knee_gap_perception.scope_pose.tracking_parameters import TrackingParameters

FRAME = 0.05  # [s] between images
PERIOD = 1 / 120
BEGIN_NS = 10**18
COVARIANCE = np.diag([4.5e-10] * 3 + [1.6e-9] * 3)


def stamp(t: float) -> int:
    return BEGIN_NS + round(1e9 * t)


def posed(position: np.ndarray, t: float) -> Any:
    covered = SimpleNamespace(pose=pose(position), covariance=COVARIANCE.ravel())
    return SimpleNamespace(header=header(stamp(t)), pose=covered)


def camera_info(joint: Any) -> Any:
    c = joint.camera
    k = [c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]
    return SimpleNamespace(
        header=header(BEGIN_NS), width=1280, height=720, distortion_model="equidistant", d=[0.0] * 4, k=k
    )


@pytest.fixture(scope="module")
def pictures(joint: Any) -> list[np.ndarray]:
    """Images of a lens that moves 0.1 mm an image."""
    places = []
    for k in range(24):
        T = np.eye(4)
        T[0, 3] = 1e-4 * k
        places.append(joint.picture(T, k))
    return places


def lens(t: float) -> np.ndarray:
    return np.array([1e-4 * t / FRAME, 0.0, 0.0])


class Chain:
    """Bodies to lens poses to edges, as tracking_node and segmentation_node pass them on."""

    def __init__(self, joint: Any, jump_hold: float = 10.0) -> None:
        self.tracker = ScopeTracker(
            TrackingParameters(body_to_shaft_translation=(0.0, 0.0, 0.0), oblique_angle=0.0),
            ValidityParameters(jump_hold=jump_hold),
        )
        self.stream = EdgeStream(poses=PoseParameters(max_pose_wait=0.0))
        self.stream.on_camera_info(camera_info(joint))
        self.edges: list[GapEdges] = []
        self.refused: list[RefusalReason] = []

    def bodies(self, times: Iterable[float], offset: np.ndarray, step: float = 0.0, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        for t in times:
            place = lens(t) + offset + rng.normal(0, 2e-5, 3)
            body = BodyPose(BEGIN_NS + round(1e9 * (t + step)), place, np.array([0.0, 0.0, 0.0, 1.0]))
            for reported in self.tracker.take(body):
                if isinstance(reported, LensPose):
                    self.stream.on_lens_pose(fill_lens_pose(posed(np.zeros(3), 0.0), reported))
                else:
                    self.refused.append(reported.reason)

    def image(self, picture: np.ndarray, t: float) -> GapEdges:
        self.stream.on_image(bgr_image(picture, stamp(t)))
        (edges,) = self.stream.ready()
        self.edges.append(edges)
        return edges


def times(begin: float, end: float) -> np.ndarray:
    return begin + PERIOD * np.arange(round((end - begin) / PERIOD))


@pytest.mark.parametrize("unseen", [0.3, 0.7])
@pytest.mark.parametrize("away", [-5e-3, 10e-3, 20e-3])
def test_a_scope_that_comes_back_elsewhere_has_another_track(
    joint: Any, pictures: list[np.ndarray], unseen: float, away: float
) -> None:
    chain, offset = Chain(joint), np.array([0.0, away, 0.0])
    back = 0.3 + unseen
    for k in range(round((back + 0.2) / FRAME)):
        t = k * FRAME + 0.01
        begin = t - FRAME
        if t < 0.3:
            chain.bodies(times(begin, t), np.zeros(3), seed=k)
        elif t > back:
            chain.bodies(times(begin, t), offset, seed=k)
        chain.image(pictures[k], t)
    before = [edges for edges in chain.edges if edges.stamp_ns < BEGIN_NS + 0.3e9 and edges.pose_used]
    after = [edges for edges in chain.edges if edges.stamp_ns > BEGIN_NS + (back + FRAME) * 1e9]
    assert {edges.status for edges in before + after} == {EdgeStatus.VALID}
    assert all(edges.pose_used for edges in after)
    assert not {edges.track_id for edges in before} & {edges.track_id for edges in after}
    assert sum(count for words, count in chain.stream.counts.items() if "ended" in words) == 1


def test_a_jump_that_is_refused_and_then_believed_has_another_track(
    joint: Any, pictures: list[np.ndarray]
) -> None:
    chain = Chain(joint, jump_hold=0.4)
    for k in range(20):
        t = k * FRAME + 0.01
        chain.bodies(times(t - FRAME, t), np.array([0.0, 0.02, 0.0]) if t > 0.3 else np.zeros(3), seed=k)
        chain.image(pictures[k], t)
    assert RefusalReason.JUMP in chain.refused
    first, last = chain.edges[3], chain.edges[-1]
    assert (last.status, last.pose_used) == (EdgeStatus.VALID, True)
    assert last.track_id != first.track_id


@pytest.mark.parametrize("step", [-0.6, 0.35, 3600.0])
def test_a_step_of_the_trackers_clock_ends_nothing_but_poses(
    joint: Any, pictures: list[np.ndarray], step: float
) -> None:
    chain = Chain(joint)
    for k in range(16):
        t = k * FRAME + 0.01
        chain.bodies(times(t - FRAME, t), np.zeros(3), step if t > 0.4 else 0.0, seed=k)
        chain.image(pictures[k], t)
    assert len(chain.edges) == 16
    assert [edges.status for edges in chain.edges[2:8]] == [EdgeStatus.VALID] * 6
    # A pose by the other clock is none of these images.
    assert not any(edges.pose_used for edges in chain.edges[9:15])


def test_each_patch_is_looked_for_where_it_is_predicted(
    joint: Any, pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first patch is predicted far away, the newest one where the point is, and there it is found."""
    grey = [np.ascontiguousarray(picture[:, :, 1]) for picture in pictures]
    pixel = np.array([660.0, 210.0])
    for away in (30.0, -30.0, 60.0, -100.0, 1e5):
        point = PointTracker(grey[0], pixel, 20.0, joint.camera, None)
        taken = [point.follow(picture, joint.camera, None) for picture in grey[1:4]]
        assert taken[-1].seen
        # A second patch, as is taken once the first one looks too different.
        point._anchors.append(PointTracker(grey[3], taken[-1].position, 20.0, joint.camera, None)._anchors[0])
        predict = point._predict

        def astray(index: int, *rest: Any, predict: Any = predict, away: float = away) -> Any:
            prediction = predict(index, *rest)
            if index == 0:
                prediction.warp.position[:] += away
            return prediction

        monkeypatch.setattr(point, "_predict", astray)
        found = point.follow(grey[4], joint.camera, None)
        assert found.seen
        np.testing.assert_allclose(found.position, joint.moved_pixels(np.eye(4), at(4), [pixel])[0], atol=1.0)


def at(k: int) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 1e-4 * k
    return T
