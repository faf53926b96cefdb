"""Inputs that lie: of what the estimator then calls valid, the truth is never outside the worst case.

A lens in a trembling hand passes two points at 60 images and 120 poses a second, with the errors that are
reported of it; then something goes wrong that is not reported.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

EXACT = EstimatorParameters(**EXACT_SCOPE)


SECOND = 10**9
IMAGES = 150
SIGMA = np.radians(0.3)
# RMS lengths of the tracker's errors.
LENS_ERROR, ROTATION_ERROR = 0.0367e-3, np.radians(0.004)
POINTS = np.array([[-2e-3, 0.0, 9.3e-3], [2e-3, 0.0, 10.7e-3]])
TREMOR = 2.0 * np.pi * np.array([4.1, 5.3, 6.2])


@dataclass
class Scope:
    """The truth, and what is reported of it, at a time [s]; a test replaces what goes wrong."""

    rng: np.random.Generator
    travel: float = 8e-3
    turn: float = 0.3
    tremor: float = 0.1e-3
    shift: Callable[[float], Array] = lambda t: np.zeros((2, 3))
    pose_reported: Callable[[LensPose, float], LensPose] = lambda pose, t: pose
    edges_reported: Callable[[GapEdges, float], GapEdges] = lambda edges, t: edges
    late: float = 0.0
    seen: Callable[[float], bool] = lambda t: True
    along: Array = field(init=False)
    offset: Array = field(init=False)

    def __post_init__(self) -> None:
        along = self.rng.standard_normal(3) * [1.0, 1.0, 0.3]
        self.along = along / np.linalg.norm(along)
        self.offset = np.sqrt(0.5) * SIGMA * self.noise()

    def noise(self) -> Array:
        """(2, 2) even in a disc, of variance 1 in each axis."""
        radius, angle = 2.0 * np.sqrt(self.rng.random(2)), 2.0 * np.pi * self.rng.random(2)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)

    def place(self, t: float) -> tuple[Array, Rotation]:
        """Where the lens is."""
        done = t / (IMAGES / 60)
        position = self.travel * done * self.along + self.tremor * np.sin(TREMOR * t)
        turned = self.turn * done * np.cross(self.along, [0.0, 0.0, 1.0]) + 200 * self.tremor * np.cos(
            TREMOR * t
        )
        return position, Rotation.from_rotvec(turned)

    def points(self, t: float) -> Array:
        """Where the points are."""
        return np.asarray(POINTS + self.shift(t))

    def gap(self, t: float) -> float:
        """The truth."""
        return float(np.linalg.norm(np.diff(self.points(t), axis=0)))

    def pose(self, t: float) -> LensPose:
        """The pose that the tracker reports."""
        position, rotation = self.place(t - self.late)
        turned = Rotation.from_rotvec(ROTATION_ERROR / np.sqrt(3) * self.rng.standard_normal(3)) * rotation
        pose = LensPose(
            SECOND + round(t * 1e9),
            "world",
            position + LENS_ERROR / np.sqrt(3) * self.rng.standard_normal(3),
            turned.as_quat(),
            np.diag(np.repeat([LENS_ERROR**2 / 3, ROTATION_ERROR**2 / 3], 3)),
        )
        return self.pose_reported(pose, t)

    def leg(self, t: float) -> LensPose:
        """The reported pose of a body fixed to the second point."""
        position = [0.1, 0.0, 0.0] + self.shift(t)[1] + LENS_ERROR / np.sqrt(3) * self.rng.standard_normal(3)
        turned = Rotation.from_rotvec(ROTATION_ERROR / np.sqrt(3) * self.rng.standard_normal(3))
        return LensPose(SECOND + round(t * 1e9), "world", position, turned.as_quat(), np.zeros((6, 6)))

    def edges(self, t: float) -> GapEdges:
        """The edges that the camera reports."""
        position, rotation = self.place(t)
        towards = rotation.inv().apply(self.points(t) - position)
        bearings = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        error = np.hstack([self.offset + np.sqrt(0.5) * SIGMA * self.noise(), np.zeros((2, 1))])
        bearings += error - np.sum(error * bearings, axis=1, keepdims=True) * bearings
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        covariances = SIGMA**2 * (np.eye(3) - bearings[:, :, None] * bearings[:, None, :])
        return self.edges_reported(
            GapEdges.of_points(
                SECOND + round(t * 1e9), 1, bearings, covariances, angular_error=3.0 * SIGMA
            ).with_rims_at_points(),
            t,
        )

    def estimates(self, estimator: GapEstimator | None = None) -> list[GapEstimate]:
        """Feed the estimator with all of it."""
        estimator = estimator or GapEstimator(EXACT)
        found = []
        for k in range(IMAGES):
            for step in range(2):
                t = (k + 0.5 * step) / 60 + 0.02
                estimator.add_leg_pose(self.leg(t - 0.006))
                found += estimator.add_pose(self.pose(t - 0.006), SECOND + round(t * 1e9))
                if step == 0 and self.seen(t):
                    found += estimator.add_edges(self.edges(t), SECOND + round(t * 1e9))
        return found + estimator.advance(SECOND + round((t + 0.03) * 1e9))

    def outside(self, estimates: list[GapEstimate]) -> list[GapEstimate]:
        """Valid estimates whose bounds do not hold the truth."""
        wrong = []
        for estimate in estimates:
            gap = self.gap((estimate.stamp_ns - SECOND) / 1e9)
            if (
                estimate.status is GapStatus.VALID
                and not estimate.point_distance_min <= gap <= estimate.point_distance_max
            ):
                wrong.append(estimate)
        return wrong


def statuses(estimates: list[GapEstimate]) -> set[GapStatus]:
    return {estimate.status for estimate in estimates}


def valid_share(estimates: list[GapEstimate]) -> float:
    return float(np.mean([estimate.status is GapStatus.VALID for estimate in estimates]))


@pytest.fixture(params=[1, 2])
def scope(request: pytest.FixtureRequest) -> Scope:
    return Scope(np.random.default_rng(request.param))


def test_nothing_wrong_is_measured(scope: Scope) -> None:
    estimates = scope.estimates()
    assert valid_share(estimates) > 0.7
    assert not scope.outside(estimates)
    last = estimates[-1]
    assert last.point_distance_confidence_min <= scope.gap(2.5) <= last.point_distance_confidence_max


def test_pose_that_freezes_while_the_scope_goes_on(scope: Scope) -> None:
    held: list[LensPose] = []

    def frozen(pose: LensPose, t: float) -> LensPose:
        if not 0.8 < t < 2.0:
            return pose
        held.append(pose)
        return replace(held[0], stamp_ns=pose.stamp_ns)

    scope.pose_reported = frozen
    estimates = scope.estimates()
    assert not scope.outside(estimates)
    during = [e for e in estimates if 1.0 < (e.stamp_ns - SECOND) / 1e9 < 1.9]
    assert GapStatus.VALID not in statuses(during)


def test_points_that_change_places(scope: Scope) -> None:
    def swapped(edges: GapEdges, t: float) -> GapEdges:
        return replace(edges, bearings=edges.bearings[::-1].copy()) if t > 1.5 else edges

    scope.edges_reported = swapped
    estimates = scope.estimates()
    assert not scope.outside(estimates)
    after = [e for e in estimates if 1.5 < (e.stamp_ns - SECOND) / 1e9 < 1.58]
    assert GapStatus.VALID not in statuses(after)
    assert GapStatus.JOINT_MOVED in statuses(estimates)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tracker_that_jumps(scope: Scope, axis: int) -> None:
    scope.pose_reported = lambda pose, t: replace(
        pose, position=pose.position + (t > 1.5) * 1e-3 * np.eye(3)[axis]
    )
    estimates = scope.estimates()
    assert not scope.outside(estimates)
    # A step that no hand makes: the views of before are of another place, and the track ends.
    after = [e.baseline for e in estimates if 1.5 < (e.stamp_ns - SECOND) / 1e9 < 1.7]
    assert np.nanmin(after) < 1e-3


def test_point_that_jumps_across_while_no_image_comes(scope: Scope) -> None:
    scope.seen = lambda t: not 1.0 < t < 1.4
    scope.shift = lambda t: np.array([[0.0, 0.0, 0.0], [0.0, 1e-3, 0.0]]) * float(t > 1.2)
    estimates = scope.estimates()
    assert not scope.outside(estimates)
    after = [e for e in estimates if 1.4 < (e.stamp_ns - SECOND) / 1e9 < 1.48]
    assert GapStatus.VALID not in statuses(after)


def slips(scope: Scope) -> None:
    """The second point goes 2 mm a second along its ray, from 0.5 s on."""
    ray = POINTS[1] / np.linalg.norm(POINTS[1])
    scope.shift = lambda t: np.array([np.zeros(3), 2e-3 * max(t - 0.5, 0.0) * ray])


def test_point_that_slips_along_its_ray_is_told_by_the_leg_body_only() -> None:
    wrong = [0, 0]
    for seed in range(6):
        for watched in (False, True):
            scope = Scope(np.random.default_rng(seed))
            slips(scope)
            parameters = EstimatorParameters(
                **EXACT_SCOPE,
                leg_motion=0.5e-3 if watched else 0.0,
                tracker_drift=0.0,
                unproven_drift=0.0,
                tracker_scale=0.0,
                tracker_angular_drift=0.0,
            )
            estimates = scope.estimates(GapEstimator(parameters))
            wrong[watched] += len(scope.outside(estimates))
            if watched:
                assert GapStatus.JOINT_MOVED in statuses(estimates)
    assert wrong[0] > 0
    assert wrong[1] == 0


def test_edge_that_is_wrong_from_the_start(scope: Scope) -> None:
    def wrong(edges: GapEdges, t: float) -> GapEdges:
        if t > 0.2:
            return edges
        bearings = edges.bearings.copy()
        bearings[1] += [0.0, np.tan(np.radians(4.0)), 0.0]
        return replace(edges, bearings=bearings / np.linalg.norm(bearings, axis=1, keepdims=True))

    scope.edges_reported = wrong
    estimates = scope.estimates()
    assert not scope.outside(estimates)
    assert GapStatus.JOINT_MOVED in statuses(estimates)
    assert valid_share(estimates[-30:]) > 0.9


@pytest.mark.parametrize("late", [0.03, 0.1])
def test_poses_that_are_stamped_late(scope: Scope, late: float) -> None:
    scope.late = late
    assert not scope.outside(scope.estimates())


def test_scope_that_only_turns(scope: Scope) -> None:
    scope.travel, scope.tremor = 0.0, 0.0
    assert GapStatus.VALID not in statuses(scope.estimates())


def test_scope_at_rest_whose_tracker_drifts(scope: Scope) -> None:
    """0.5 mm/s over 2.5 s: as far as a travel that would be measured."""
    scope.travel = 0.0
    scope.pose_reported = lambda pose, t: replace(pose, position=pose.position + 0.5e-3 * t * np.eye(3)[0])
    assert not scope.outside(scope.estimates())


def test_images_that_come_twice_change_nothing() -> None:
    once = Scope(np.random.default_rng(3)).estimates()
    scope, estimator = Scope(np.random.default_rng(3)), GapEstimator(EXACT)
    add_edges = estimator.add_edges

    def twice(edges: GapEdges, arrival_ns: int, queued_ns: int = 0) -> list[GapEstimate]:
        return add_edges(edges, arrival_ns, queued_ns) + add_edges(edges, arrival_ns, queued_ns)

    estimator.add_edges = twice  # type: ignore[method-assign]
    assert [repr(e) for e in scope.estimates(estimator)] == [repr(e) for e in once]
    assert estimator.counts["images with the stamp of the one before"] == IMAGES


def test_bag_that_starts_again_gives_the_same_again() -> None:
    estimator = GapEstimator(EXACT)
    first = Scope(np.random.default_rng(4)).estimates(estimator)
    again = Scope(np.random.default_rng(4)).estimates(estimator)
    assert [repr(e) for e in again[-IMAGES:]] == [repr(e) for e in first[-IMAGES:]]
