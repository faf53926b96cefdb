"""The views of a track that are kept for the fit, so that it stays bounded in size and does not drift."""

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.multi_view.views import Views, joined

CAPACITY = 240
# A view is worth keeping where the lens is this many RMS errors of its position away from all views kept: a
# lens that stands still reaches that in 1 of 10^5 images.
SPACING = 5.0
# What the spacing is multiplied by each time the window is full.
COARSER = 1.25


class ViewWindow:
    """Up to `capacity` views, spread over the places the lens has been.

    A lens that stands still adds nothing: its many images share their errors, and by their number they would
    push out the views that carry the parallax. Where the window is full the spacing grows and the views that
    have become too close to earlier ones give way. The image that shows the lens to have moved on is not kept
    but the next: of the images around the threshold the first beyond it is the one whose error points
    outward, and its lens position would be biased.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        if capacity < 2:
            raise BadInputError(f"a window must hold at least 2 views, not {capacity}")
        self._capacity = capacity
        self._views: list[Views] = []
        # All of them in one, because a live track asks for them at every image; None while there is none.
        self._all: Views | None = None
        self._spacing = SPACING
        self._moved_on = False

    def __len__(self) -> int:
        """Number of views kept."""
        return len(self._views)

    def add(self, view: Views) -> bool:
        """Take a single view; return whether it was kept.

        Raises BadInputError where `view` does not hold exactly one view.
        """
        if len(view) != 1:
            raise BadInputError(f"one view is added at a time, not {len(view)}")
        keep = self._moved_on or not self._views
        self._moved_on = not keep and self._is_apart(view, self._positions())
        if keep:
            self._views.append(view)
            self._all = view if self._all is None else self._all.joined(view)
            while len(self._views) > self._capacity:
                self._thin()
                self._all = joined(self._views, view.common_share)
        return keep

    def views(self, common_share: float) -> Views:
        """The views kept, in the order of time.

        Raises BadInputError while there is none.
        """
        if self._all is None:
            raise BadInputError("the window is empty: add a view first")
        return joined([self._all], common_share)

    def _positions(self) -> Array:
        """Lens positions (N, 3) [m] of the views kept, at least one."""
        assert self._all is not None
        return self._all.lens_positions

    def _is_apart(self, view: Views, positions: Array) -> bool:
        """Whether the lens is more than the spacing away from all of the positions (n, 3) [m]."""
        nearest = float(np.linalg.norm(positions - view.lens_positions, axis=1).min())
        return nearest > self._spacing * float(np.sqrt(np.trace(view.lens_covariances[0])))

    def _thin(self) -> None:
        """Widen the spacing; of the views too close for it the earliest stays, and the newest does."""
        self._spacing *= COARSER
        kept: list[Views] = []
        for view in self._views:
            places = [other.lens_positions for other in kept]
            if not kept or view is self._views[-1] or self._is_apart(view, np.concatenate(places)):
                kept.append(view)
        # Views of errors so small that no spacing thins them.
        self._views = kept if len(kept) < len(self._views) else [kept[0], *kept[2:]]
