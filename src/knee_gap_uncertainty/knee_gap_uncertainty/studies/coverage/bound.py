"""The least standard deviation of the gap that any unbiased estimate can have: Cramer and Rao's bound."""

from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.likelihood import Linearised, Measured, blank, linearise, mean_frames
from knee_gap_uncertainty.multi_view.maximum_likelihood import points_jacobian
from knee_gap_uncertainty.multi_view.variance_shares import common_root, considered_covariance, gap_gradient
from knee_gap_uncertainty.multi_view.views import bearing_covariances
from knee_gap_uncertainty.studies.coverage.cells import SHARES, Cell
from knee_gap_uncertainty.studies.coverage.tracks import deviations, true_bearings, true_track


class Bound(NamedTuple):
    """Standard deviations at the truth [m]: least of the gap, and of the depth of the worse point.

    `gap_considered`: least of the gap where the offset common to a track's bearings is not estimated;
    `gap_offset_known_constant`: where it is, because it is taken to be exactly the same in every view.
    """

    gap_considered: float
    gap_offset_known_constant: float
    depth: float


def bound(cell: Cell) -> Bound:
    """Bound of a cell, from the likelihood at the truth with the true errors."""
    lens, points = true_track(cell.scene, cell.view_count)
    bearings = true_bearings(lens, points)
    count = cell.view_count
    deviation, lens_variance, rotation_variance = deviations(cell)
    frames, centre = mean_frames(bearings), lens.mean(axis=0)
    measured = Measured(
        lens,
        bearings,
        bearing_covariances(bearings, deviation),
        np.tile(np.eye(3) * lens_variance, (count, 1, 1)),
        np.tile(np.eye(3) * rotation_variance, (count, 1, 1)),
        np.tile(np.eye(3), (count, 1, 1)),
        centre,
        frames,
    )
    coordinates = np.einsum("nak,nk->na", frames, points - centre)
    unknowns = np.column_stack([coordinates[:, 1:], np.ones(2)]) / coordinates[:, :1]
    out = blank(count)
    linearise(measured, np.ones((count, 2), dtype=np.bool_), unknowns, out)
    inverse = np.linalg.inv(out.information)
    considered = np.zeros((6, 6))
    considered_covariance(out, SHARES[cell.share], inverse, considered, np.zeros((6, 4)))
    gradient = gap_gradient(frames, unknowns)
    jacobian = points_jacobian(frames, unknowns)
    place = jacobian @ considered @ jacobian.T
    depths = [place[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for n in range(2)]
    return Bound(
        gap_considered=float(np.sqrt(gradient @ considered @ gradient)),
        gap_offset_known_constant=_with_constant_offset(out, SHARES[cell.share], gradient),
        depth=float(np.sqrt(max(frames[n, 0] @ depths[n] @ frames[n, 0] for n in range(2)))),
    )


def _with_constant_offset(out: Linearised, share: float, gradient: Array) -> float:
    """Bound of the gap from the covariance of all residuals; NaN where all of the image error is common."""
    if share == 1.0:
        return float("nan")
    count = len(out.residuals)
    covariance = np.zeros((4 * count, 4 * count))
    common = np.zeros((4 * count, 4))
    slopes = np.zeros((4 * count, 6))
    root = np.zeros((2, 2, 2))
    for i in range(count):
        rows = slice(4 * i, 4 * i + 4)
        covariance[rows, rows] = np.linalg.inv(out.weights[i])
        for n in range(2):
            two = slice(4 * i + 2 * n, 4 * i + 2 * n + 2)
            common_root(out.image_covariances, i, n, share, root)
            covariance[two, two] -= root[n] @ root[n]
            common[two, 2 * n : 2 * n + 2] = root[n]
            slopes[two, 3 * n : 3 * n + 3] = out.jacobians[i, n]
    information = slopes.T @ np.linalg.solve(covariance + common @ common.T, slopes)
    return float(np.sqrt(gradient @ np.linalg.solve(information, gradient)))
