"""Warm-up of the estimate: all compiled code is compiled or loaded from disk before the first image.

The kernels are compiled for the kinds of arrays that reach them; so a whole short track is estimated, as it
would be live, with advice beside it and edges that jump at its end.
"""

from typing import Literal

import numpy as np

from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.joint_motion import motion_statistics
from knee_gap_uncertainty.motion_advice.motion_advice import AdviceParameters
from knee_gap_uncertainty.multi_view import maximum_likelihood as multi_view
from knee_gap_uncertainty.two_view import gap_range

FRAME_NS = 16_666_667
HALF_POSE_NS = 4_000_000
POINTS = np.array([[0.0, -0.002, 0.010], [0.0005, 0.002, 0.011]])
IMAGES = 40
TRAVEL = 0.006
JUMP_AT = 34
SIGMA = 3e-3


def warm_up() -> set[GapStatus]:
    """Compile what is not on disk yet, load the rest; return the statuses that the track went through."""
    gap_range.warm_up()
    multi_view.warm_up()
    motion_statistics.warm_up()
    statuses: set[GapStatus] = set()
    targets: tuple[Literal["snr", "width"], ...] = ("snr", "width")
    for target in targets:
        statuses |= _estimate_track(AdviceParameters(advice_target=target))
    return statuses


def _estimate_track(advice: AdviceParameters) -> set[GapStatus]:
    """Feed a scope that travels past two points to an estimator."""
    estimator = GapEstimator(advice=advice)
    estimates = []
    for k in range(IMAGES):
        stamp_ns, lens = (k + 1) * FRAME_NS, np.array([TRAVEL * k / IMAGES, 0.0, 0.0])
        aim = POINTS + (np.array([0.0, 0.002, 0.0]) if k >= JUMP_AT else 0.0)
        for pose_ns in (stamp_ns - HALF_POSE_NS, stamp_ns + HALF_POSE_NS):
            estimates += estimator.add_pose(_pose(pose_ns, lens), stamp_ns)
            if pose_ns < stamp_ns:
                estimates += estimator.add_edges(_edges(stamp_ns, lens, aim), stamp_ns)
        estimates += estimator.advance(stamp_ns)
    return {estimate.status for estimate in estimates}


def _pose(stamp_ns: int, lens: "np.typing.NDArray[np.float64]") -> LensPose:
    """The pose of a lens that does not turn."""
    covariance = np.diag([4.5e-10] * 3 + [1.6e-9] * 3)
    return LensPose(stamp_ns, "world", lens, np.array([0.0, 0.0, 0.0, 1.0]), covariance)


def _edges(
    stamp_ns: int, lens: "np.typing.NDArray[np.float64]", points: "np.typing.NDArray[np.float64]"
) -> GapEdges:
    """The points as that lens sees them."""
    bearings = (points - lens) / np.linalg.norm(points - lens, axis=1, keepdims=True)
    planes = np.eye(3) - bearings[:, :, None] * bearings[:, None, :]
    edges = GapEdges.of_points(stamp_ns, 1, bearings, SIGMA**2 * planes, 3.0 * SIGMA)
    return edges.with_rims_at_points()


if __name__ == "__main__":
    warm_up()
