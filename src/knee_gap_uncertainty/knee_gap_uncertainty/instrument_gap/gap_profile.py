"""The instrument gap at more sections along the visible opening, from the same two surfaces.

Only beside the chosen section is the distance of the tissue measured. Away from it each side is taken to lie
as deep, and to have the same shape, with an error that grows with the distance along the opening.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import SectionEdges
from knee_gap_uncertainty.instrument_gap.gap_kernels import gap_bounds, widest
from knee_gap_uncertainty.instrument_gap.instrument_gap import (
    ROUGHNESS_BOUND,
    TILTS,
    Edges,
    Opening,
    opening_of,
)

# How fast the depth of a side may change along the opening [-]: 17 degrees.
STEEPEST = 0.3
# How much wider [m] another section must be before the chosen one is no longer called the widest.
MUCH_WIDER = 0.2e-3


class GapProfile(NamedTuple):
    """The fields of knee_gap_msgs/GapProfile: a number [m] for each section, in order along the opening."""

    stamp_ns: int
    frame_id: str
    track_id: int
    position: Array
    gap: Array
    gap_min: Array
    gap_max: Array

    @property
    def widest(self) -> int:
        """Index of the section with the largest gap; -1 where none is known."""
        return int(np.nanargmax(self.gap)) if np.isfinite(self.gap).any() else -1

    @property
    def chosen_is_widest(self) -> bool:
        """Whether no section is wider than the chosen one, at position 0, by more than MUCH_WIDER."""
        if self.widest < 0:
            return False
        chosen = self.gap[int(np.argmin(np.abs(self.position)))]
        return bool(self.gap[self.widest] - chosen <= MUCH_WIDER)


def gap_profile(
    stamp_ns: int,
    frame_id: str,
    track_id: int,
    sections: Sequence[SectionEdges],
    rotation: Array,
    ranges: Array,
    near_far: tuple[Array, Array],
    opening: Opening,
    edges: Edges,
) -> GapProfile:
    """The profile over `sections`, whose bearings `rotation` (3, 3) takes to the frame of the points.

    `ranges` (2,) [m] are the distances of the tracked points in the plane of the chosen section, `near_far`
    (2,) [m] the least and greatest that the admitted errors allow; `opening` and `edges` belong
    to the chosen section.
    """
    along = np.cross(opening.across, opening.view)
    depth = float(ranges.mean())
    rows = []
    for section in sections:
        bearings = section.bearings @ rotation.T
        middle = bearings.sum(axis=0)
        ahead = float(middle @ opening.view)
        if not (np.isfinite(bearings).all() and ahead > 0.0 and np.isfinite(section.error)):
            rows.append((np.nan, np.nan, np.nan, np.nan))
            continue
        position = depth * float(middle @ along) / ahead
        here = opening_of(bearings, bearings)
        # The same depth along the chosen section's direction of view.
        farther = 1.0 / max(float(here.view @ opening.view), 0.2)
        wrong = STEEPEST * abs(position)
        near, far = (np.maximum(near_far[0] * farther - wrong, 1e-4), near_far[1] * farther + wrong)
        gap = widest(here.half, ranges * farther, opening.insets, *edges.shapes, TILTS)[0]
        errors = (section.error, 0.0)
        lower, upper = gap_bounds(near, far, here.half, opening.insets, *errors, *edges.shapes, TILTS)
        rows.append((position, gap, max(lower - ROUGHNESS_BOUND, 0.0), upper + ROUGHNESS_BOUND))
    position, gap, lower, upper = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    known = np.flatnonzero(np.isfinite(position))
    order = known[np.argsort(position[known], kind="stable")]
    return GapProfile(stamp_ns, frame_id, track_id, position[order], gap[order], lower[order], upper[order])
