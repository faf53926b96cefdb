"""Refuses images of an oblique scope that was turned since its calibration, where nothing else tells it.

The turn moves the lens about the shaft, and only a second tracked body lets `tracking_node` follow it frame
by frame. Where there is none the notch in the image still shows the turn: then nothing is valid.
"""

import numpy as np
import numpy.typing as npt

from knee_gap_perception.calibration.calibration_file import Calibration
from knee_gap_perception.calibration.notch import find_notch
from knee_gap_perception.field_of_view import FieldOfViewFinder

LARGEST_TURN = np.radians(3.0)
EVERY = 12  # images: five times a second at 60 Hz, and a tenth of the cost
AGREEING = 2  # looks in a row before the word changes: something dark at the border is no notch


class NotchGuard:
    """Looks at the notch of every twelfth image. Where it is not seen, what was last known holds."""

    def __init__(self, calibration: Calibration) -> None:
        oblique = calibration.oblique
        self._calibration: Calibration | None = None
        # Where a second body tells the turn, the tracker follows it.
        if oblique is not None and oblique.T_head_scope is None and np.isfinite(oblique.notch_angle):
            self._calibration = calibration
        self._finder = FieldOfViewFinder()
        self._count = 0
        self._agreeing = 0
        self.flaw = ""

    def look(self, image: npt.NDArray[np.uint8]) -> str:
        """Why an image (h, w, 3) cannot be measured in, in words; empty where the scope is as calibrated."""
        if self._calibration is None:
            return ""
        self._count += 1
        if (self._count - 1) % EVERY:
            return self.flaw
        field = self._finder.find(image)
        notch = find_notch(image, field) if field is not None else None
        if notch is None:
            return self.flaw
        turn = self._calibration.scope_turn(notch.angle)
        is_turned = abs(turn) > LARGEST_TURN
        self._agreeing = self._agreeing + 1 if is_turned != bool(self.flaw) else 0
        if self._agreeing >= AGREEING or (is_turned and self.flaw):
            self._agreeing = 0
            self.flaw = (
                f"the scope is turned by {np.degrees(turn):.0f} deg in its camera head since the "
                "calibration, which only a second tracked body (scope_turn_body) can follow: turn it back "
                "or calibrate again"
                if is_turned
                else ""
            )
        return self.flaw
