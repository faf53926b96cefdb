"""Detection of bodies whose labels the tracker has exchanged."""

from collections.abc import Iterable

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, is_place

# A label is on another body when it is this many times nearer to that body's last place than to its own.
MUCH_NEARER = 4.0
# Two bodies are never this close [m], so a label that moved less has not been swapped.
SEPARATION = 0.005
# A place so long ago [ns] does not limit where a body is now.
FORGET_NS = 10_000_000_000


class SwappedBodies:
    """Follows bodies by where they are, and compares that with what the tracker calls them.

    Each frame is judged by itself from the last place of each body, so that a swap which began or ended
    unseen, behind an occlusion, does not turn the names round for good.
    """

    def __init__(self) -> None:
        self._places: dict[str, tuple[int, Array]] = {}

    def update(self, bodies: Iterable[BodyPose]) -> dict[str, str]:
        """Take the bodies of one frame; return, for each label that is on another body, that body's name."""
        seen = {body.name: body for body in bodies if body.tracking_valid and is_place(body.position)}
        claims = {label: claim for label, body in seen.items() if (claim := self._claim(label, body))}
        # A body that is seen where it was, under its own name, is not to be had by another label.
        while taken := [label for label, claim in claims.items() if claim in seen and claim not in claims]:
            for label in taken:
                del claims[label]
        for label, body in seen.items():
            self._places[claims.get(label, label)] = (body.stamp_ns, body.position)
        return claims

    def _claim(self, label: str, body: BodyPose) -> str | None:
        """The other body whose place the label has come to, if it left its own for it."""
        own = self._distance(label, body)
        if own is None or own < SEPARATION:
            return None
        others = ((self._distance(name, body), name) for name in self._places if name != label)
        near = [(distance, name) for distance, name in others if distance is not None]
        if not near or MUCH_NEARER * min(near)[0] >= own:
            return None
        return min(near)[1]

    def _distance(self, name: str, body: BodyPose) -> float | None:
        place = self._places.get(name)
        if place is None or body.stamp_ns - place[0] > FORGET_NS:
            return None
        return float(np.linalg.norm(body.position - place[1]))
