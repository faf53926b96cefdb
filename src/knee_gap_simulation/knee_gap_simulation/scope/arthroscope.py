"""The simulated rigid scope: pose of its lens on the tracked body."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, radians, sin
from typing import Any

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, quaternion_xyzw


@dataclass(frozen=True)
class Scope:
    """A 30 degree arthroscope with a marker cluster behind its handle.

    ``shaft_origin`` [m] and ``shaft_turn`` (rotation vector [rad]) place the shaft frame on the body:
    origin at the lens, z along the shaft to the tip, x right and y down in the image of a straight scope.
    The body's axes depend on the markers, so they agree with the shaft only roughly. ``oblique_angle`` [rad]
    tilts the view to the top of the image.
    """

    shaft_origin: tuple[float, float, float] = (0.0035, -0.0120, 0.2000)
    shaft_turn: tuple[float, float, float] = (0.055, -0.031, -0.070)
    oblique_angle: float = radians(30.0)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "Scope":
        """The scope of `dataclasses.asdict`."""
        x, y, z = values["shaft_origin"]
        a, b, c = values["shaft_turn"]
        return Scope((x, y, z), (a, b, c), values["oblique_angle"])

    def body_to_shaft(self) -> Array:
        """``T_body_shaft`` (4, 4)."""
        return from_rotation_vectors(self.shaft_turn, self.shaft_origin)

    def body_to_lens(self) -> Array:
        """``T_body_lens`` (4, 4)."""
        return self.body_to_shaft() @ from_rotation_vectors([self.oblique_angle, 0.0, 0.0], np.zeros(3))

    def shaft_in_lens(self) -> tuple[float, float, float]:
        """Direction of the shaft, to the tip, in the frame of the lens."""
        return 0.0, sin(self.oblique_angle), cos(self.oblique_angle)

    def parameters(self) -> dict[str, float | list[float]]:
        """The scope as parameters of the tracking node."""
        return {
            "body_to_shaft_translation": list(self.shaft_origin),
            "body_to_shaft_quaternion_xyzw": quaternion_xyzw(self.body_to_shaft()).tolist(),
            "oblique_angle": self.oblique_angle,
        }
