"""Which views of a track are kept for the fit, so that it stays bounded in size and does not drift."""

import numpy as np

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
        self._moved_on = not keep and self._is_apart(view, self._views)
        if keep:
            self._views.append(view)
            while len(self._views) > self._capacity:
                self._thin()
        return keep

    def views(self, common_share: float) -> Views:
        """The views kept, in the order of time.

        Raises BadInputError while there is none.
        """
        if not self._views:
            raise BadInputError("the window is empty: add a view first")
        return joined(self._views, common_share)

    def _is_apart(self, view: Views, others: list[Views]) -> bool:
        """Whether the lens is more than the spacing away from all of the others."""
        positions = np.concatenate([other.lens_positions for other in others])
        nearest = float(np.linalg.norm(positions - view.lens_positions, axis=1).min())
        return nearest > self._spacing * float(np.sqrt(np.trace(view.lens_covariances[0])))

    def _thin(self) -> None:
        """Widen the spacing; of the views too close for it the earliest stays, and the newest does."""
        self._spacing *= COARSER
        kept: list[Views] = []
        for view in self._views:
            if not kept or view is self._views[-1] or self._is_apart(view, kept):
                kept.append(view)
        # Views of errors so small that no spacing thins them.
        self._views = kept if len(kept) < len(self._views) else [kept[0], *kept[2:]]
