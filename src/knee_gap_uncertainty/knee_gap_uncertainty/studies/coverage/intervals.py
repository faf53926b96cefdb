"""Intervals of all simulated tracks of a cell."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.confidence_interval import LARGEST_INVERSE_DEPTH_VARIATION
from knee_gap_uncertainty.studies.coverage.cells import Cell
from knee_gap_uncertainty.studies.coverage.tracks import Tracks
from knee_gap_uncertainty.studies.many_tracks import fit_all

LEVEL = 0.95


class Intervals(NamedTuple):
    """Of every track (R,): gap [m], NaN at infinity, both ends [m], relative error of inverse depth [-]."""

    gap: Array
    lower: Array
    upper: Array
    variation: Array

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Whether the estimator would have given the interval."""
        return self.variation <= LARGEST_INVERSE_DEPTH_VARIATION


def intervals(tracks: Tracks, cell: Cell) -> Intervals:
    """Intervals at 95 % as the estimator gives them, with the errors that the cell assumes."""
    columns = fit_all(
        tracks.lens,
        tracks.bearings,
        tracks.deviation * cell.assumed_scale,
        tracks.lens_variance,
        tracks.rotation_variance,
        cell.assumed_share,
        float(norm.ppf(0.5 + 0.5 * LEVEL)),
    )
    return Intervals(*columns)
