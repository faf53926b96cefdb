"""The edges of the opening in the frame of the points, carried on for a while where no image shows them."""

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeState, GapEdges, SectionEdges
from knee_gap_uncertainty.instrument_gap.instrument_gap import Edges, opening_of
from knee_gap_uncertainty.scope_calibration.posed_view import PosedView

NOT_YET = "no image of the track has shown the edges of the opening"
UNSEEN = "the edges of the opening were not seen for too long"
NOT_FINITE = "the edges are marked as seen and carry numbers that cannot be used"

# An edge of smooth bone lies up to half as far again from the lens as the point beside it: while the lens
# moves by a share of that distance, the edge moves against the point by at most this share of it [rad].
SLIDE = 0.5
# What a section that is not seen may change by otherwise [rad/s].
UNSEEN_RATE = 0.02


class SectionInView:
    """Gives the edges at each view of a track, and remembers where they were against the points."""

    def __init__(self, longest_unseen: float) -> None:
        """`longest_unseen` [s]: how long edges are carried on that no image shows."""
        self._longest_unseen = longest_unseen
        self._insets: Array | None = None
        self._across = np.zeros(3)
        self._lens = np.zeros(3)
        self._stamp_ns = 0
        self._error = self._image_error = float("nan")
        self._deviations = np.zeros(2)

    def at(self, observation: GapEdges, view: PosedView, distance: float) -> Edges | str:
        """The edges at a view, whose nearer point lies at a `distance` [m]; or why there are none.

        Edges at the border of the picture are returned with `bounded` false: the opening is wider than them.
        """
        section = observation.section
        if any(state == EdgeState.UNKNOWN for state in section.states):
            return self._carried(observation, view, distance)
        if not _is_usable(section):
            return NOT_FINITE
        assert view.view.lens_rotations is not None
        bearings = section.bearings @ view.view.lens_rotations[0].T
        bounded = all(state == EdgeState.SEEN for state in section.states)
        edges = Edges(bearings, section.deviations, section.error, observation.kinds, bounded)
        if bounded:
            opening = opening_of(view.bearings, bearings)
            self._insets, self._across = opening.insets, opening.across
            self._lens, self._stamp_ns = view.lens, observation.stamp_ns
            self._error, self._deviations = section.error, section.deviations
            self._image_error = observation.angular_error
        return edges

    def _carried(self, observation: GapEdges, view: PosedView, distance: float) -> Edges | str:
        """The edges where they were against their points when they were last seen, with a larger error."""
        if self._insets is None:
            return NOT_YET
        unseen = 1e-9 * (observation.stamp_ns - self._stamp_ns)
        if not 0.0 <= unseen <= self._longest_unseen:
            return UNSEEN
        middle = view.bearings.sum(axis=0)
        middle = middle / np.linalg.norm(middle)
        across = self._across - (self._across @ middle) * middle
        across = across / max(float(np.linalg.norm(across)), 1e-9)
        angles = np.arctan2(view.bearings @ across, view.bearings @ middle) + self._insets * [1.0, -1.0]
        bearings = np.cos(angles)[:, None] * middle + np.sin(angles)[:, None] * across
        moved = float(np.linalg.norm(view.lens - self._lens)) / max(distance, 1e-6)
        growth = SLIDE * moved + UNSEEN_RATE * unseen
        # The inset held the point's error then, and the present point has its own.
        image_error = self._image_error + observation.angular_error
        bounded = EdgeState.AT_BORDER not in observation.section.states
        return Edges(
            bearings,
            np.sqrt(self._deviations**2 + (growth / 2.0) ** 2 + (image_error / 3.0) ** 2),
            self._error + growth + image_error,
            observation.kinds,
            bounded,
        )


def _is_usable(section: SectionEdges) -> bool:
    """Whether the numbers of edges that are seen are finite and in range."""
    numbers = (section.bearings, section.deviations, section.error)
    if not all(np.isfinite(values).all() for values in numbers):
        return False
    lengths = np.linalg.norm(section.bearings, axis=1)
    return bool(np.abs(lengths - 1.0).max() < 1e-6 and section.deviations.min() > 0.0 and section.error > 0.0)
