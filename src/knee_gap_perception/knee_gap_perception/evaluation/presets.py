"""Presets of the image error: the paper's measurements on cadavers (Table 2), for `angular_error`.

The paper's text gives 2.36 degrees for the medial compartment; its Table 2 has that number in the row of the
patello-femoral joint. The labels here are those of Table 2.
"""

from dataclasses import dataclass

from numpy import radians

from knee_gap_perception.errors import PerceptionError


@dataclass(frozen=True)
class ImageErrorPreset:
    """One row of Table 2: compartment of the knee, and RMS errors [rad] at G0 and G1 and their average."""

    location: str
    image_set: int
    error_0: float
    error_1: float
    average: float


PRESETS = {
    "medial": ImageErrorPreset("medial compartment", 2, radians(5.215), radians(3.388), radians(4.302)),
    "patellofemoral": ImageErrorPreset(
        "patello-femoral joint", 3, radians(1.961), radians(2.774), radians(2.367)
    ),
    "lateral": ImageErrorPreset("lateral compartment", 6, radians(4.048), radians(7.125), radians(5.586)),
}


def image_error_preset(name: str) -> ImageErrorPreset:
    """Row of Table 2 by name. Raises PerceptionError for an unknown name."""
    if name not in PRESETS:
        raise PerceptionError(f"the image error preset must be one of {', '.join(PRESETS)}, not '{name}'")
    return PRESETS[name]
