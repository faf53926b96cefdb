"""Fits and intervals of many tracks at once, compiled: what a study of the estimator runs."""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.common_offset import gap_of
from knee_gap_uncertainty.multi_view.confidence_interval import interval_ends
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit_arrays


@compiled
def fit_all(
    lens: Array,
    bearings: Array,
    deviation: float,
    lens_variance: float,
    rotation_variance: float,
    common_share: float,
    radius: float,
) -> Array:
    """(4, R): gap [m], lower and upper end [m], relative error of inverse depth [-] of every track.

    `lens` (R, N, 3) [m], `bearings` (R, N, 2, 3), of one `deviation` [rad] in both image axes; variances of
    each component of the lens position [m^2] and rotation [rad^2]. `radius` is the two-sided normal deviate
    of the level. The gap is NaN, and the relative error infinite, where a point lies at or beyond infinity.
    """
    run_count, count = lens.shape[0], lens.shape[1]
    result = np.full((4, run_count), np.nan)
    bearing_covariances = np.zeros((count, 2, 3, 3))
    lens_covariances = np.zeros((count, 3, 3))
    rotation_covariances = np.zeros((count, 3, 3))
    axes = np.zeros((count, 3, 3))
    for i in range(count):
        for k in range(3):
            lens_covariances[i, k, k] = lens_variance
            rotation_covariances[i, k, k] = rotation_variance
            axes[i, k, k] = 1.0
    for run in range(run_count):
        for i in range(count):
            for n in range(2):
                for row in range(3):
                    for column in range(3):
                        across = 1.0 if row == column else 0.0
                        across -= bearings[run, i, n, row] * bearings[run, i, n, column]
                        bearing_covariances[i, n, row, column] = deviation * deviation * across
        fitted = fit_arrays(
            lens[run],
            bearings[run],
            bearing_covariances,
            lens_covariances,
            rotation_covariances,
            axes,
            common_share,
        )
        ends = interval_ends(fitted.frames, fitted.unknowns, fitted.covariance, radius, fitted.bend)
        result[1, run], result[2, run], result[3, run] = ends[0], ends[1], np.inf
        if fitted.unknowns[0, 2] > 0.0 and fitted.unknowns[1, 2] > 0.0:
            result[0, run] = gap_of(fitted.frames, fitted.unknowns)
            result[3, run] = max(
                np.sqrt(fitted.covariance[2, 2]) / fitted.unknowns[0, 2],
                np.sqrt(fitted.covariance[5, 5]) / fitted.unknowns[1, 2],
            )
    return result
