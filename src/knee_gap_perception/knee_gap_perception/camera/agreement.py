"""Comparison of two models of one camera."""

import numpy as np

from knee_gap_perception.camera.camera import Camera

# Half a degree [rad]: 4 px of a usual scope, far beyond the errors of a calibration.
NOTABLE = np.radians(0.5)
# Fraction of the image's half height within which they are compared: a model is unreliable beyond its data.
INNER = 0.7


def disagreement(one: Camera, other: Camera) -> str:
    """Difference between the bearings of two cameras, in words; empty if it is negligible."""
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
