"""Rays against the distance fields of the knee, and the light that reaches a point: compiled kernels.

Frame, units, ``shape``, ``waves`` and ``probe`` are those of `distance_field`.
"""

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.surfaces.distance_field import field, normal, surface_distance

_STEP_SHARE = 0.85
_MAX_STEPS = 400
_CLOSE = 0.3e-3


@compiled(nogil=True)
def march(
    origin: Array,
    dx: float,
    dy: float,
    dz: float,
    start: float,
    tolerance: float,
    shape: Array,
    waves: Array,
    probe: Array,
) -> tuple[float, int]:
    """Length of a ray to the first surface closer than ``tolerance``, and the surface; NaN, -1 for none."""
    t, step, before = start, 0.0, 0.0
    surface = -1
    for _ in range(_MAX_STEPS):
        distance, surface = field(
            origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz, shape, waves, probe
        )
        if distance < tolerance:
            # One step too far: back to the zero of the line through the last two distances.
            if distance < -tolerance and before > 0.0:
                t -= step * distance / (distance - before)
            return t, surface
        forward = _STEP_SHARE * distance
        # Close to a surface at a slant, the last step predicts the remaining distance.
        if distance < _CLOSE and before > distance:
            forward = max(forward, min(2.0 * distance, step * distance / (before - distance)))
        before, step = distance, forward
        t += step
        if t > 0.2:
            return np.nan, -1
    return t, surface


@compiled(nogil=True)
def free_lengths(
    origin: Array,
    directions: Array,
    spread: float,
    shape: Array,
    waves: Array,
    probe: Array,
    lengths: Array,
) -> None:
    """Free length of cones of half angle ``spread`` [rad] around each direction (n, 3)."""
    for i in range(directions.shape[0]):
        t = 0.0
        for _ in range(_MAX_STEPS):
            x, y, z = (
                origin[0] + t * directions[i, 0],
                origin[1] + t * directions[i, 1],
                origin[2] + t * directions[i, 2],
            )
            room = field(x, y, z, shape, waves, probe)[0] - spread * t
            if room < 0.02e-3 or t > 0.2:
                break
            t += _STEP_SHARE * room / (1.0 + spread)
        lengths[i] = t


@compiled(nogil=True)
def polish(
    origin: Array,
    dx: float,
    dy: float,
    dz: float,
    t: float,
    surface: int,
    shape: Array,
    waves: Array,
    probe: Array,
) -> float:
    """Length of a ray to a surface, refined to rounding from a length within a few micrometres of it."""
    step = 1e-7
    for _ in range(6):
        here = surface_distance(
            origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz, surface, shape, waves, probe
        )
        ahead = t + step
        there = surface_distance(
            origin[0] + ahead * dx,
            origin[1] + ahead * dy,
            origin[2] + ahead * dz,
            surface,
            shape,
            waves,
            probe,
        )
        slope = (there - here) / step
        # A grazing ray has no crossing: keep its closest point.
        if slope > -1e-3:
            break
        change = -here / slope
        if abs(change) > 2e-5:
            break
        t += change
        if abs(change) < 1e-13:
            break
    return t


@compiled(nogil=True)
def cast(
    origin: Array,
    directions: Array,
    starts: Array,
    exact: bool,
    shape: Array,
    waves: Array,
    probe: Array,
    lengths: Array,
    surfaces: npt.NDArray[np.uint8],
    normals: Array,
) -> None:
    """First surface along each ray beyond ``starts``, with normals."""
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i]
        lengths[i] = np.nan
        surfaces[i] = 255
        normals[i, 0] = normals[i, 1] = normals[i, 2] = np.nan
        if not np.isfinite(dx):
            continue
        t, surface = march(origin, dx, dy, dz, starts[i], 1e-6 if exact else 3e-6, shape, waves, probe)
        if surface < 0:
            continue
        if exact:
            t = polish(origin, dx, dy, dz, t, surface, shape, waves, probe)
        lengths[i], surfaces[i] = t, surface
        x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
        normals[i, 0], normals[i, 1], normals[i, 2] = normal(x, y, z, surface, shape, waves, probe)


@compiled(nogil=True)
def light_reach(
    points: Array,
    normals: Array,
    lamp: Array,
    shape: Array,
    waves: Array,
    probe: Array,
    reach: Array,
) -> None:
    """Fractions of light that reach points (n, 3): reach (n, 2), of the lamp (soft shadow) and ambient."""
    for i in range(points.shape[0]):
        px, py, pz = points[i]
        nx, ny, nz = normals[i]
        reach[i, 0] = reach[i, 1] = 1.0
        if not np.isfinite(nx):
            continue
        openness = 0.0
        for k in range(3):
            h = 0.4e-3 * 3.0**k
            distance, _ = field(px + h * nx, py + h * ny, pz + h * nz, shape, waves, probe)
            openness += min(1.0, max(0.0, distance) / h) / 3.0
        reach[i, 1] = openness
        lx, ly, lz = lamp[0] - px, lamp[1] - py, lamp[2] - pz
        far = np.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / far, ly / far, lz / far
        t, open_share = 0.25e-3, 1.0
        for _ in range(40):
            x, y, z = px + t * lx + 2e-5 * nx, py + t * ly + 2e-5 * ny, pz + t * lz + 2e-5 * nz
            distance, _ = field(x, y, z, shape, waves, probe)
            # The lamp has a width: a surface close to the ray covers a part of it.
            open_share = min(open_share, 0.5 + distance / (0.16 * t * (1.0 - t / far) + 1e-9))
            if open_share <= 0.0:
                open_share = 0.0
                break
            t += max(0.8 * distance, 0.3e-3, 0.1 * t)
            if t > 0.9 * far:
                break
        reach[i, 0] = open_share * open_share * (3.0 - 2.0 * open_share)
