"""What an image error that grows with the parallax does to a gap: the point drifts along its first ray.

Light that moves with the scope, relief that is taken for a plane and a contour that slides let a followed
point lag behind its parallax, or run ahead of it, by a share that stays much the same over a track. Bearings
that are wrong by a share s of their parallax since the first view are without a contradiction the bearings of
a point whose distance from the first lens is smaller by that share. No residual shows it, so it is
considered: each point's covariance grows along the ray from the first lens.

How large that share is, the bearings' own covariances show best: they differ between a rim and a contour, and
where little texture is shared it is the registrations themselves that are wrong in the same way. So of what
the best single views leave open of a point's depth a share of the variance lasts, however many views there
are; what the covariances do not contain is added.
"""

from dataclasses import replace

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, points_jacobian
from knee_gap_uncertainty.multi_view.views import Views

# [rad] by which a bearing would turn were its point at the first lens: below it a view does not measure
# depth.
LEAST_TURN = 1e-4
# Share of the views that may claim to measure a depth better: one whose stated error is 0 must not count
# for all.
TOO_GOOD = 0.1


def with_scale_drift(
    fit: MultiViewFit, views: Views, first_lens: Array, drift: float, correlated_error_share: float
) -> MultiViewFit:
    """The fit with a drift in its covariances and in the common part of its shares.

    `first_lens` (3,) [m] is the lens of the track's first view; `drift` [-] the standard deviation of the
    share that no covariance contains, independent in both points; `correlated_error_share` [-] the share of
    the variance that the best of the `views` leave open and that lasts over a track. With none of both, and
    where a point lies at infinity, the fit is returned as it is.
    """
    if not ((drift > 0.0 or correlated_error_share > 0.0) and np.isfinite(fit.points).all()):
        return fit
    variances = np.full(2, drift**2)
    if correlated_error_share > 0.0:
        variances += correlated_error_share * fit.scale * np.square(single_view_drift(fit, views, first_lens))
    added = np.zeros((6, 6))
    for n in range(2):
        ray = fit.points[n] - first_lens
        added[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = variances[n] * np.outer(ray, ray)
    return widened(fit, added)


def single_view_drift(fit: MultiViewFit, views: Views, first_lens: Array) -> Array:
    """Standard deviation (2,) [-] of the drift of each point that one of the best views leaves open.

    `first_lens` (3,) [m] is the lens of the track's first view. A drift by a share s turns the bearing of a
    view by s times the ray from the first lens, across the bearing and against the distance; the bearing's
    error beside that turn is unknown as well. It is the first decile over the views that measure any. At most
    1: with no parallax at all, nothing is known.
    """
    rays = fit.points - first_lens
    observations = fit.points - views.lens_positions[:, None]
    distances = np.linalg.norm(observations, axis=-1, keepdims=True)
    bearings = observations / distances
    turned = (rays - np.sum(rays * bearings, axis=-1, keepdims=True) * bearings) / distances
    size = np.linalg.norm(turned, axis=-1)
    known = fit.used & (size > LEAST_TURN)
    towards = turned / np.where(known, size, 1.0)[..., None]
    beside = np.cross(bearings, towards)
    own, both, other = (
        np.einsum("vni,vnij,vnj->vn", a, views.bearing_covariances, b)
        for a, b in ((towards, towards), (towards, beside), (beside, beside))
    )
    spread = own - np.divide(both**2, other, out=np.zeros_like(own), where=other > 0.0)
    variances = np.divide(spread, size**2, out=np.ones_like(size), where=known).clip(0.0, 1.0)
    best = [np.quantile(variances[known[:, n], n], TOO_GOOD) if known[:, n].any() else 1.0 for n in range(2)]
    return np.asarray(np.sqrt(best))


def widened(fit: MultiViewFit, added: Array) -> MultiViewFit:
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
