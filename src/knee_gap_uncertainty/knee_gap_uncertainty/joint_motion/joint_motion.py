"""Test whether the two points stand still, as the analysis assumes, on the residuals of every image.

`motion_statistics` measures how far the residuals are from those of points at rest; here that is judged,
image by image.
"""

from enum import Enum

import numpy as np

from knee_gap_uncertainty.joint_motion.creep import DEVIATIONS
from knee_gap_uncertainty.joint_motion.motion_statistics import (
    LARGEST_PRESENT,
    MotionStatistics,
    Observations,
    motion_statistics,
    observations,
)
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.multi_view.views import Views

# So many more contradicting images than agreeing ones end the track; fewer while it is young.
FEWEST_CONTRADICTIONS = 5
# One bearing in 20,000 exceeds it by chance: it is tested at every image and the price is the track.
LARGEST_FIRST = 19.8
# Fewer than 1 track in 100 of 600 images exceeds it by chance, by simulation: see `joint_motion_table`.
LARGEST_SHIFT = 26.0
# Of a rate, in deviations of what is known and admitted of it, with 3 degrees of freedom.
LARGEST_CREEP = 20.0


class Finding(Enum):
    """Result of the test: whether the points are at rest."""

    STILL = "the points stand still"
    CONTRADICTION = "the present bearings contradict the track"
    MOVED = "a point moved against the reference"


class JointMotionTest:
    """The sequential test of one track.

    An image that contradicts is a doubt that it takes an agreeing one to clear: where an edge was wrong from
    the start, its path crosses the true one now and then.
    """

    def __init__(self, admitted_rate: float = 0.0, unproven_rate: float = 0.0) -> None:
        """Rates [m/s] at which the tracked body may creep: RMS length, and per axis before any view."""
        self._rates = (admitted_rate, unproven_rate)
        # Rate [m/s] along the baseline that the views leave possible, if the tracked body creeps.
        self.largest_rate = DEVIATIONS * unproven_rate
        # Images found still.
        self.still_count = 0
        self._doubts = 0

    def judge(self, views: Views, fitted: MultiViewFit | None, passing: Views | None = None) -> Finding:
        """Finding at the last of `views`, all earlier ones having been found still.

        `fitted`: the fit over `views`, None if there is none; `passing`: a single view from just before
        the last that is not among them. A contradicting view must not be kept.
        """
        observed = observations(views)
        if passing is not None:
            between = observations(passing)
            observed = Observations(
                *(np.concatenate([a[:-1], b, a[-1:]]) for a, b in zip(observed, between, strict=True))
            )
        return self.decide(motion_statistics(observed, fitted, self._rates))

    def decide(self, found: MotionStatistics) -> Finding:
        """Finding at the present view from its statistics."""
        self.largest_rate = found.largest_rate
        if found.present > LARGEST_PRESENT:
            self._doubts += 1
            # A young track is no better founded than what contradicts it.
            enough = min(FEWEST_CONTRADICTIONS, self.still_count)
            return Finding.MOVED if self._doubts >= enough else Finding.CONTRADICTION
        if self._doubts > 1:
            self._doubts -= 1
            return Finding.CONTRADICTION
        self._doubts = 0
        moved = found.first > LARGEST_FIRST or found.shift > LARGEST_SHIFT
        if moved or found.creep > LARGEST_CREEP:
            return Finding.MOVED
        self.still_count += 1
        return Finding.STILL
