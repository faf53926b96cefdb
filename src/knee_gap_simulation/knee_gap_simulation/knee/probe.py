"""The surgeon's probe: a slender hook that enters, covers a place for some time, and leaves."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors
from knee_gap_simulation.knee.difficulty import PROBE_PERIOD_S
from knee_gap_simulation.knee.scene import NO_PROBE
from knee_gap_simulation.scope.hand_motion import minimum_jerk

_MOVE_S = 0.35
_RETREAT = 0.022

# One joint of an instrument [m]: its place along the shaft, back from the tip, and along the hook; radius.
Rod = tuple[float, float, float]
HOOK: tuple[Rod, ...] = (
    (0.030, 0.0, 0.00085),
    (0.006, 0.0, 0.00075),
    (0.0, 0.0, 0.00045),
    (0.0, 0.0016, 0.00033),
)


@dataclass(frozen=True)
class Probe:
    """Visits (from, to) [s] to places (k, 3) of the scene, one place after the other, repeated in time.

    ``rods`` are its joints; ``heading`` [rad] turns the side from which it comes, about the scene's z.
    """

    visits: tuple[tuple[float, float], ...]
    places: tuple[tuple[float, float, float], ...]
    side: float  # -1 or 1: the side of the image from which it enters
    rods: tuple[Rod, ...] = HOOK
    heading: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """The probe as plain values for JSON; rods and heading only if they are not the hook's."""
        usual = {"rods": HOOK, "heading": 0.0}
        return {name: value for name, value in asdict(self).items() if usual.get(name) != value}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "Probe":
        """The probe of `as_dict`."""
        visits = tuple((float(begin), float(end)) for begin, end in values["visits"])
        places = tuple((float(x), float(y), float(z)) for x, y, z in values["places"])
        rods = tuple((float(a), float(b), float(radius)) for a, b, radius in values.get("rods", HOOK))
        return Probe(visits, places, float(values["side"]), rods, float(values.get("heading", 0.0)))

    def joints(self, time: float) -> Array:
        """The rods (k, 4) at a time [s]: x y z and radius of each joint; empty while it is away."""
        round_, phase = divmod(time, PROBE_PERIOD_S)
        for index, (begin, end) in enumerate(self.visits):
            inside = min(phase - begin, end - phase) / _MOVE_S
            if inside > 0.0:
                place = self.places[(int(round_) * len(self.visits) + index) % len(self.places)]
                return self._at(np.array(place), 1.0 - float(minimum_jerk(inside)), time)
        return NO_PROBE

    def _at(self, place: Array, withdrawn: float, time: float) -> Array:
        back = np.array([0.80 * self.side, 0.30, -0.52])
        back /= np.linalg.norm(back)
        if self.heading != 0.0:
            back = from_rotation_vectors([0.0, 0.0, self.heading * self.side], np.zeros(3))[:3, :3] @ back
        sway = 0.15e-3 * np.array([np.sin(7.0 * time), np.cos(5.0 * time), 0.0])
        knuckle = place + sway + (0.0006 + _RETREAT * withdrawn) * back
        hook = np.array([0.15 * self.side, -0.95, 0.25])
        return np.array(
            [[*(knuckle + along * back + out * hook), radius] for along, out, radius in self.rods]
        )
