"""What an image error that grows with the parallax does to a gap: the point drifts along its first ray.

Light that moves with the scope, relief that is taken for a plane and a contour that slides let a followed
point lag behind its parallax, or run ahead of it, by a share that stays much the same over a track. Bearings
that are wrong by a share s of their parallax since the first view are without a contradiction the bearings of
a point whose distance from the first lens is smaller by that share. No residual tells it, so it is
considered: each point's covariance grows along the ray from the first lens.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.multi_view import MultiViewFit, points_jacobian


def with_depth_drift(fit: MultiViewFit, first_lens: npt.NDArray[np.float64], drift: float) -> MultiViewFit:
    """The fit with a drift in its covariances and in the common part of its shares.

    `first_lens` (3,) [m] is the lens of the track's first view, `drift` [-] the standard deviation of the
    share, independent in both points. With none the fit is returned as it is.
    """
    if not (drift > 0.0 and np.isfinite(fit.points).all()):
        return fit
    added = np.zeros((6, 6))
    for n in range(2):
        ray = drift * (fit.points[n] - first_lens)
        added[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = np.outer(ray, ray)
    return widened(fit, added)


def widened(fit: MultiViewFit, added: npt.NDArray[np.float64]) -> MultiViewFit:
    """The fit with a covariance (6, 6) [m^2] of both points added, as common part of its shares."""
    inverse = np.linalg.inv(points_jacobian(fit.frames, fit.unknowns))
    wider = replace(
        fit,
        covariance=fit.covariance + added,
        unknowns_covariance=fit.unknowns_covariance + inverse @ added @ inverse.T,
    )
    kept = fit.gap_deviation**2 / wider.gap_deviation**2
    shares = fit.shares * kept
    shares[3] += 1.0 - kept
    return replace(wider, shares=shares)
