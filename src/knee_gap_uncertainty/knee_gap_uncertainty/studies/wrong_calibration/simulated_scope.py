"""A scope whose calibration is wrong by as much as is stated of it, and the estimates that follow."""

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances
from knee_gap_uncertainty.scope_calibration.scope_calibration import ScopeCalibration

EXACT = EstimatorParameters(**EXACT_SCOPE)


POINTS = np.array([[0.001, -0.002, 0.0], [0.0005, 0.0025, 0.001]])
SIGMA, LENS_RMS, TURN_RMS = np.radians(0.1), 0.0367e-3, np.radians(0.004)
FRAME_NS = 16_666_667


class Hand:
    """A scope that travels past the points at 8 mm/s and turns by 20 degrees, and what is wrong with it.

    `wrong` (7,): shift [m] and turn [rad] of the lens on its body, and of the clock [s].
    """

    def __init__(self, rng: np.random.Generator, wrong: Array, count: int = 150) -> None:
        self._rng, self._wrong, self.count = rng, wrong, count
        way = rng.standard_normal(3) * [1.0, 1.0, 0.3]
        axis = rng.standard_normal(3)
        self._way, self._axis = way / np.linalg.norm(way), axis / np.linalg.norm(axis)
        self._rate, self._phase = 2 * np.pi / rng.uniform(1.5, 4.0), rng.uniform(0.0, 6.0)

    def true(self, time: float) -> tuple[Array, Rotation]:
        """Position [m] and rotation of the lens."""
        along = 0.008 * (time - self.count / 120.0) + 0.0015 * np.sin(3.0 * time + self._phase)
        turn = self._axis * np.radians(10.0) * np.sin(self._rate * time + self._phase)
        return self._way * along - [0.0, 0.0, 0.011], Rotation.from_rotvec(turn)

    def tracked(self, time: float, *, noise: bool = True) -> tuple[Array, Rotation]:
        """The same, as a tracker with the wrong calibration has it."""
        place, rotation = self.true(time + self._wrong[6])
        place = place + rotation.apply(self._wrong[:3])
        rotation = rotation * Rotation.from_rotvec(self._wrong[3:6])
        if not noise:
            return place, rotation
        place = place + LENS_RMS / np.sqrt(3) * self._rng.standard_normal(3)
        return place, Rotation.from_rotvec(TURN_RMS / np.sqrt(3) * self._rng.standard_normal(3)) * rotation

    def bearings(self, time: float, points: Array) -> Array:
        """Unit vectors (2, 3) to the points, without noise, in the frame of the lens."""
        place, rotation = self.true(time)
        seen: Array = rotation.inv().apply(points - place)
        return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))

    def views(self, step: int = 5) -> Views:
        """Views without noise, as tracked, in the world's frame."""
        times = np.arange(0, self.count, step) / 60.0
        poses = [self.tracked(time, noise=False) for time in times]
        late = [self.tracked(time + 1e-4, noise=False) for time in times]
        motions = [
            np.concatenate([(b[0] - a[0]), (b[1] * a[1].inv()).as_rotvec()]) / 1e-4
            for a, b in zip(poses, late, strict=True)
        ]
        bearings = np.array(
            [pose[1].apply(self.bearings(time, POINTS)) for time, pose in zip(times, poses, strict=True)]
        )
        return Views(
            np.array([pose[0] for pose in poses]),
            bearings,
            bearing_covariances(bearings, SIGMA),
            isotropic_covariances(len(times), LENS_RMS),
            isotropic_covariances(len(times), TURN_RMS),
            lens_rotations=np.array([pose[1].as_matrix() for pose in poses]),
            lens_motions=np.array(motions),
        )


def stated(shift: float, turn: float) -> Array:
    """Covariance (6, 6) of a shift [m] and a turn [rad] of these RMS lengths."""
    return np.diag(np.repeat([shift**2 / 3, turn**2 / 3], 3))


def drawn(rng: np.random.Generator, shift: float, turn: float, clock: float) -> Array:
    """An error (7,) of these RMS lengths [m], [rad], [s]."""
    size = np.concatenate([np.repeat([shift, turn], 3) / np.sqrt(3), [clock]])
    return np.asarray(size * rng.standard_normal(7))


def wrong_scope(
    seed: int, shift: float, turn: float, clock: float, moved: Array | None = None
) -> list[GapEstimate]:
    """The estimator on a track with an error drawn from what is stated; a point may move on the way."""
    rng = np.random.default_rng([seed, 11])
    hand = Hand(rng, drawn(rng, shift, turn, clock))
    estimator, found = GapEstimator(EXACT), []
    for node, covariance, error in (
        ("tracking_node", stated(shift, turn), clock),
        ("segmentation_node", np.full((6, 6), np.nan), np.nan),
    ):
        estimator.add_calibration(ScopeCalibration(node, "a" * 64, covariance, error))
    common = SIGMA * np.sqrt(0.5) * rng.standard_normal((2, 2))
    pose_covariance = np.diag(np.repeat([LENS_RMS**2 / 3, TURN_RMS**2 / 3], 3))
    for k in range(hand.count):
        time, stamp = k / 60.0, 10**9 + k * FRAME_NS
        points = POINTS.copy()
        if moved is not None:
            points[0] += np.clip((k - hand.count / 2) / 20.0, 0.0, 1.0) * moved
        for late_ns in (-2_000_000, 2_000_000):
            place, rotation = hand.tracked(time + 1e-9 * late_ns)
            pose = LensPose(stamp + late_ns, "world", place, rotation.as_quat(), pose_covariance)
            found += estimator.add_pose(pose, stamp + late_ns)
            if late_ns < 0:
                noise = common + SIGMA * np.sqrt(0.5) * rng.standard_normal((2, 2))
                bearings = hand.bearings(time, points) + np.column_stack([noise, np.zeros(2)])
                bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
                covariances = bearing_covariances(bearings, SIGMA)
                edges = GapEdges.of_points(stamp, 1, bearings, covariances, 3.0 * SIGMA).with_rims_at_points()
                found += estimator.add_edges(edges, stamp)
    return found
