"""The view that the bounds of a track are made with, beside the present one."""

from dataclasses import dataclass

import numpy as np

from knee_gap_uncertainty.scope_calibration.posed_view import PosedView

# Least cosine of the angle, seen from the farthest view, between the first and the present lens: what a track
# knows of creep it knows along its travel.
LEAST_COSINE = 0.9


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
        """The first view, or the farthest if the present lens is farther from that for its errors."""
        farthest = self.farthest
        if farthest is None or _merit(self.first, present) >= _merit(farthest, present):
            return self.first
        there, here = self.first.lens - farthest.lens, present.lens - farthest.lens
        along = float(there @ here) / max(float(np.linalg.norm(there) * np.linalg.norm(here)), 1e-12)
        return farthest if along >= LEAST_COSINE else self.first


def between(one: PosedView, other: PosedView) -> float:
    """Distance of the lens between two views [m]."""
    return float(np.linalg.norm(one.lens - other.lens))


def _merit(view: PosedView, present: PosedView) -> float:
    return between(view, present) / max(view.angular_error, present.angular_error)
