"""Whether two models of one camera say the same."""

import numpy as np

from knee_gap_perception.camera.models import Camera

# Half of a degree [rad]: 4 px of a usual scope, far beyond the errors of a calibration.
NOTABLE = np.radians(0.5)
# Share of the image's half height in which both are compared: a model says little of what it never saw.
INNER = 0.7


def disagreement(one: Camera, other: Camera) -> str:
    """By how much the bearings of two cameras differ, in words; empty where it is nothing to speak of."""
    sizes = [(camera.width_px, camera.height_px) for camera in (one, other)]
    if sizes[0] != sizes[1]:
        return f"its image size, {sizes[1][0]}x{sizes[1][1]} against {sizes[0][0]}x{sizes[0][1]} px"
    centre = one.pixels([0.0, 0.0, 1.0])
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    radii = np.linspace(0.0, INNER * one.height_px / 2, 4)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    pixels = centre + radii[:, None, None] * circle
    apart = np.linalg.norm(one.bearings(pixels) - other.bearings(pixels), axis=-1)
    worst = float(np.nanmax(apart)) if np.isfinite(apart).any() else np.inf
    return f"{np.degrees(worst):.1f} deg" if worst > NOTABLE else ""
