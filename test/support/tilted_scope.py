"""A tilted scope that sees two points from exact places at 60 images a second, for tests of the estimator."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

EXACT = EstimatorParameters(**EXACT_SCOPE)

MS = 1_000_000
FRAME_NS = 16_666_667
POINTS = np.array([[0.001, 0.0, 0.012], [-0.002, 0.003, 0.012]])
TRUE_GAP = float(np.linalg.norm(POINTS[1] - POINTS[0]))
# In steps that a hand can make between two images.
TRAVEL = [float(x) for x in np.linspace(0.0, 0.006, 13)]
TILT = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])


def pose(stamp_ns: int, x: float, frame_id: str = "world") -> LensPose:
    return LensPose(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        position=np.array([x, 0.0, 0.0]),
        quaternion_xyzw=TILT.as_quat(),
        covariance=np.diag([1e-12] * 6),
    )


def edges(stamp_ns: int, x: float, track_id: int = 1, usable: bool = True) -> GapEdges:
    towards = TILT.inv().apply(POINTS - [x, 0.0, 0.0])
    bearings = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    sigma = np.radians(0.1)
    covariances = sigma**2 * (np.eye(3) - bearings[:, :, None] * bearings[:, None, :])
    seen = GapEdges.of_points(stamp_ns, track_id, bearings, covariances, angular_error=np.radians(0.3))
    status = EdgeStatus.VALID if usable else EdgeStatus.UNKNOWN
    return replace(seen.with_rims_at_points(), status=status)


def run(
    estimator: GapEstimator, positions: list[float], track_id: int = 1, begin: int = 10**9
) -> list[GapEstimate]:
    """Images at 60 Hz with a pose 1 ms before and after each."""
    estimates = []
    for k, x in enumerate(positions):
        stamp = begin + k * FRAME_NS
        estimates += estimator.add_pose(pose(stamp - MS, x), stamp)
        estimates += estimator.add_edges(edges(stamp, x, track_id), stamp + MS)
        estimates += estimator.add_pose(pose(stamp + MS, x), stamp + 2 * MS)
    return estimates
