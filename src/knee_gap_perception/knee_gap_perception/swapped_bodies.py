"""Whether the tracker has exchanged the labels of two bodies."""

from collections.abc import Callable, Sequence

import numpy as np

from knee_gap_perception.poses import BodyPose

MUCH_NEARER = 4.0
# Two bodies are never this close [m], so a label that moved less has not been swapped.
SEPARATION = 0.005

Reach = Callable[[BodyPose, BodyPose], float]


class SwappedBodies:
    """Follows bodies by where they are and compares that with what the tracker calls them.

    A label that leaves its body for the place of another body, while that other label comes to the first
    place or is gone, has been swapped; it stays so until it swaps back.
    """

    def __init__(self) -> None:
        self._last: dict[str, BodyPose] = {}
        self._body_of_label: dict[str, str] = {}

    def update(self, body: BodyPose, others: Sequence[BodyPose], reach: Reach) -> str | None:
        """Take the bodies of one frame; return the body that the label of `body` is on, if not its own.

        `reach(start, end)` is how far two poses are from each other as a share of what the fastest motion
        reaches in the time between them; above 1 they are not of the same body.
        """
        seen = {pose.name: pose for pose in (body, *others) if pose.tracking_valid}
        for first in seen:
            for second in self._last:
                if first != second and self._exchanged(seen, first, second, reach):
                    self._exchange(first, second)
                    self._last[first], self._last[second] = self._last[second], self._last[first]
        self._last.update(seen)
        holder = self._body_of_label.get(body.name, body.name)
        return None if holder == body.name else holder

    def _exchanged(self, seen: dict[str, BodyPose], first: str, second: str, reach: Reach) -> bool:
        if first not in self._last:
            return False
        if np.abs(seen[first].position - self._last[first].position).max() < SEPARATION:
            return False
        own, foreign = reach(self._last[first], seen[first]), reach(self._last[second], seen[first])
        if second not in seen:
            return foreign <= 1.0 < own
        # Compared with each other, not with 1: after a drop-out both places may be within reach.
        other_own, other_foreign = (
            reach(self._last[second], seen[second]),
            reach(self._last[first], seen[second]),
        )
        return MUCH_NEARER * foreign < own and MUCH_NEARER * other_foreign < other_own

    def _exchange(self, first: str, second: str) -> None:
        holders = self._body_of_label
        holders[first], holders[second] = holders.get(second, second), holders.get(first, first)
