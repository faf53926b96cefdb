"""Scale drift: an image error that grows with the parallax, by which a point drifts along its first ray.

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

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Mask
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.numerics.vectors import Vector, cross, dot, norm, row, scale, subtract, unit, vector

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
    return _best_drifts(fit.points, views.lens_positions, views.bearing_covariances, fit.used, first_lens)


@compiled
def _best_drifts(points: Array, lens: Array, covariances: Array, used: Mask, first_lens: Array) -> Array:
    """`single_view_drift` on plain arrays."""
    drifts = np.ones(2)
    variances = np.empty(lens.shape[0])
    for n in range(2):
        point, count = row(points, n), 0
        ray = subtract(point, vector(first_lens))
        for i in range(lens.shape[0]):
            observation = subtract(point, row(lens, i))
            distance = norm(observation)
            bearing = scale(1.0 / distance, observation)
            turned = scale(1.0 / distance, subtract(ray, scale(dot(ray, bearing), bearing)))
            size = norm(turned)
            if not (used[i, n] and size > LEAST_TURN):
                continue
            towards = scale(1.0 / size, turned)
            beside = cross(bearing, towards)
            spread = _form(covariances[i, n], towards, towards)
            other = _form(covariances[i, n], beside, beside)
            if other > 0.0:
                spread -= _form(covariances[i, n], towards, beside) ** 2 / other
            variances[count] = min(max(spread / size**2, 0.0), 1.0)
            count += 1
        if count > 0:
            place = TOO_GOOD * (count - 1)
            ordered = np.sort(variances[:count])
            below = int(place)
            above = min(below + 1, count - 1)
            drifts[n] = np.sqrt(ordered[below] + (place - below) * (ordered[above] - ordered[below]))
    return drifts


@compiled
def _form(matrix: Array, left: Vector, right: Vector) -> float:
    """Bilinear form of a (3, 3) matrix."""
    return dot(left, (dot(row(matrix, 0), right), dot(row(matrix, 1), right), dot(row(matrix, 2), right)))


def widened(fit: MultiViewFit, added: Array) -> MultiViewFit:
    """The fit with a covariance (6, 6) [m^2] of both points added, as common part of its shares."""
    covariance, unknowns_covariance, shares = _widened(
        fit.covariance, fit.unknowns_covariance, fit.frames, fit.unknowns, fit.points, fit.shares, added
    )
    return replace(fit, covariance=covariance, unknowns_covariance=unknowns_covariance, shares=shares)


@compiled
def _widened(
    covariance: Array,
    unknowns_covariance: Array,
    frames: Array,
    unknowns: Array,
    points: Array,
    shares: Array,
    added: Array,
) -> tuple[Array, Array, Array]:
    """The three fields that `widened` changes."""
    inverse = np.zeros((6, 6))
    gradient = np.zeros(6)
    along = unit(subtract(row(points, 1), row(points, 0)))
    for n in range(2):
        a, b, rho = unknowns[n]
        for k in range(3):
            u = frames[n, 0, k]
            inverse[3 * n, 3 * n + k] = rho * (frames[n, 1, k] - a * u)
            inverse[3 * n + 1, 3 * n + k] = rho * (frames[n, 2, k] - b * u)
            inverse[3 * n + 2, 3 * n + k] = -rho * rho * u
            gradient[3 * n + k] = (2 * n - 1) * along[k]
    before, after, wider = 0.0, 0.0, covariance + added
    unknowns_added = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            before += gradient[i] * covariance[i, j] * gradient[j]
            after += gradient[i] * wider[i, j] * gradient[j]
            for k in range(6):
                for m in range(6):
                    unknowns_added[i, j] += inverse[i, k] * added[k, m] * inverse[j, m]
    kept = before / after
    changed = shares * kept
    changed[3] += 1.0 - kept
    return wider, unknowns_covariance + unknowns_added, changed
