"""The notch of one scope through its images: reported as seen only if it is sure."""

from dataclasses import dataclass
from math import nan

import numpy as np
import numpy.typing as npt

from knee_gap_perception.image.field_of_view import FieldOfViewFinder
from knee_gap_perception.scope_rotation.notch import NOTCH_SIGMA, Notch, NotchShape, notches

FASTEST_TURN = 12.0  # [rad/s] of a scope in its camera head, by hand
SLACK = np.radians(2.0)  # beyond what the fastest turn reaches
FORGOTTEN_NS = 500_000_000  # without a sight, after which the notch may be anywhere
OBSERVATIONS_TO_BEGIN = 3  # in a row, each within reach of the one before, before the first counts

NO_FIELD = "the round border of the picture is not seen"
NO_NOTCH = "the notch at the border of the picture is not seen"
SEVERAL = "several things at the border of the picture look like the notch"
FAR_AWAY = "what looks like the notch is too far from where the notch was"
NOT_SURE = "what looks like the notch has not been there for long enough"


@dataclass(frozen=True)
class NotchObservation:
    """Where the notch is in the image of a stamp: `angle` and its standard error [rad], NaN if not seen.

    `reason` is why it is not seen, empty if it is. The angle is that of `Notch`.
    """

    stamp_ns: int
    angle: float
    angle_error: float
    reason: str = ""

    @property
    def seen(self) -> bool:
        """Whether the angle is known."""
        return not self.reason


class NotchFollower:
    """Takes the images of one scope in order. The notch has a known shape and does not jump.

    What looks like it where it cannot have come to since it was last seen is not taken for it, and a first
    sight counts when two more have confirmed it.
    """

    def __init__(self, shape: NotchShape) -> None:
        self._shape = shape
        self._finder = FieldOfViewFinder()
        self._last: tuple[int, float] | None = None
        self._observations = 0

    def look(self, stamp_ns: int, image: npt.NDArray[np.uint8]) -> NotchObservation:
        """Look for the notch in the next image (h, w, 3)."""
        if self._last is not None and not 0 < stamp_ns - self._last[0] <= FORGOTTEN_NS:
            self._last, self._observations = None, 0
        field = self._finder.find(image)
        if field is None or not np.isfinite(field.radius):
            return self._not_seen(stamp_ns, NO_FIELD)
        found = notches(image, field, self._shape)
        near = [notch for notch in found if self._within_reach(stamp_ns, notch)]
        if not near:
            if self._observations < OBSERVATIONS_TO_BEGIN:
                # Nothing was sure yet: begin again with what is there now.
                self._last, self._observations = None, 0
                near = found
            if not near:
                return self._not_seen(stamp_ns, FAR_AWAY if found else NO_NOTCH)
        if len(near) > 1:
            return self._not_seen(stamp_ns, SEVERAL)
        self._last = stamp_ns, near[0].angle
        self._observations += 1
        if self._observations < OBSERVATIONS_TO_BEGIN:
            return self._not_seen(stamp_ns, NOT_SURE)
        return NotchObservation(stamp_ns, near[0].angle, NOTCH_SIGMA)

    def _within_reach(self, stamp_ns: int, notch: Notch) -> bool:
        if self._last is None:
            return True
        seconds = (stamp_ns - self._last[0]) / 1e9
        away = abs((notch.angle - self._last[1] + np.pi) % (2 * np.pi) - np.pi)
        return bool(away <= FASTEST_TURN * seconds + SLACK)

    @staticmethod
    def _not_seen(stamp_ns: int, reason: str) -> NotchObservation:
        return NotchObservation(stamp_ns, nan, nan, reason)
