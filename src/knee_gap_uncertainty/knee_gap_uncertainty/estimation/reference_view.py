"""The view that the bounds of a track are made with, beside the present one."""

from dataclasses import dataclass

import numpy as np

from knee_gap_uncertainty.scope_calibration.posed_view import PosedView


@dataclass
class ReferenceViews:
    """The first view of a track, and the one whose lens is farthest from it.

    A scope that comes back to where the track began has its baseline to the latter.
    """

    first: PosedView
    farthest: PosedView | None = None

    def note(self, view: PosedView) -> None:
        """Take a view in which the points are where the track has them."""
        if self.farthest is None or between(view, self.first) > between(self.farthest, self.first):
            self.farthest = view

    def of(self, present: PosedView) -> PosedView:
        """The one of both whose lens is farther from the present lens."""
        if self.farthest is None or between(present, self.first) >= between(present, self.farthest):
            return self.first
        return self.farthest


def between(one: PosedView, other: PosedView) -> float:
    """Distance of the lens between two views [m]."""
    return float(np.linalg.norm(one.lens - other.lens))
