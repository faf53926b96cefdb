"""Dense samples of the tissue around an opening, exactly on its surfaces."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.surfaces.distance_field import (
    CAPSULE,
    CONDYLE,
    FREE_EDGE,
    MENISCUS,
    PLATEAU,
    ridge,
    ripple,
    surface_distance,
)

# Sides of the opening: the tissue above it, below it, and the wall of the joint around both.
UPPER_SIDE, LOWER_SIDE, AROUND = 0, 1, 2

SPACING = 0.06e-3  # of points on a surface [m]
RIM_SPACING = 0.01e-3  # of points along a sharp rim [m]
_WALL_SPACING = 0.15e-3  # on the wall of the joint, which is farther from any instrument
_SLIDE = 2.5e-3  # [m]: farther than any ripple moves a surface
_NO_PROBE = np.zeros((0, 4))


class TissueSamples(NamedTuple):
    """Points (n, 3) [m] on tissue, and on which side (n,) of the opening they lie."""

    points: Array
    sides: npt.NDArray[np.int64]


def joined(parts: list[tuple[int, Array]], centre: Array, reach: float) -> TissueSamples:
    """The points of several surfaces, each on one side, that lie within ``reach`` [m] of a centre (3,)."""
    points = np.concatenate([part for _, part in parts])
    sides = np.concatenate([np.full(len(part), side, np.int64) for side, part in parts])
    # NaN compares as false: points that are not on a surface are dropped.
    kept = ((points - centre) ** 2).sum(axis=1) <= reach * reach
    return TissueSamples(np.ascontiguousarray(points[kept]), sides[kept])


def angles_off(origin: Array, direction: Array, points: Array) -> Array:
    """Angles (n,) [rad] between a line of sight and points (n, 3); beyond a right angle for those behind."""
    away = points - origin
    along = away @ direction
    return np.asarray(np.arctan2(np.linalg.norm(away - along[:, None] * direction, axis=1), along))


def steps(low: float, high: float, spacing: float) -> Array:
    """Positions from low to high, both included, at most ``spacing`` apart; empty if high is below low."""
    if not high >= low:
        return np.empty(0)
    return np.linspace(low, high, int(np.ceil((high - low) / spacing)) + 1)


def knee_samples(shape: Array, waves: Array, centre: Array, reach: float) -> TissueSamples:
    """Samples of a knee within ``reach`` [m] of a centre (3,) in its scene; arrays as in `knee_field`."""
    low, high = centre - reach, centre + reach
    along = steps(low[0], high[0], SPACING)
    deep = steps(low[2], high[2], SPACING)
    flat = np.stack(np.meshgrid(along, deep, indexing="ij"), axis=-1).reshape(-1, 2)
    plateau_points = np.stack([flat[:, 0], _plateau_heights(flat, shape), flat[:, 1]], axis=-1)
    _slide(plateau_points, np.broadcast_to([0.0, 1.0, 0.0], plateau_points.shape), PLATEAU, shape, waves)
    rims = steps(low[0], high[0], RIM_SPACING)
    rim_points = np.empty((len(rims), 3))
    _along_ridge(rims, shape, waves, rim_points)
    width = shape[24] + 0.5e-3
    down = steps(0.0, width, SPACING)
    wedge = np.stack(np.meshgrid(along, down, indexing="ij"), axis=-1).reshape(-1, 2)
    faces = np.full((3, len(wedge), 3), np.nan)
    _on_meniscus(wedge, shape, waves, faces)
    meniscus_points = faces.reshape(-1, 3)
    return joined(
        [
            (UPPER_SIDE, _ellipsoid_points(shape, 0, CONDYLE, SPACING, waves, centre, reach)),
            (LOWER_SIDE, plateau_points),
            (LOWER_SIDE, rim_points),
            (LOWER_SIDE, meniscus_points),
            (AROUND, _ellipsoid_points(shape, 6, CAPSULE, _WALL_SPACING, waves, centre, reach)),
        ],
        centre,
        reach,
    )


def _plateau_heights(flat: Array, shape: Array) -> Array:
    """Heights y (n,) of the plateau without its ripples, at places x, z (n, 2)."""
    x, z = flat.T
    before = np.maximum(0.0, shape[16] - z)
    return np.asarray(
        shape[12] + shape[13] * x + shape[14] * z + shape[15] * x * x + 0.5 * shape[17] * before * before
    )


def _ellipsoid_points(
    shape: Array,
    first: int,
    surface: int,
    spacing: float,
    waves: Array,
    centre: Array,
    reach: float,
) -> Array:
    """Points on a rippled ellipsoid: rings around its x axis, projected along rays from its centre."""
    middle, radii = shape[first : first + 3], shape[first + 3 : first + 6]
    # Rings at equal angles from the x axis, so that they are dense enough near its ends too.
    angles = steps(0.0, np.pi, spacing / radii.max())
    x = middle[0] - radii[0] * np.cos(angles)
    margin = 2e-3
    angles = angles[np.abs(x - centre[0]) <= reach + margin]
    rounds = steps(-np.pi, np.pi, spacing / radii.max())[:-1]
    unit = np.stack(
        [
            np.repeat(-np.cos(angles), len(rounds)),
            (np.sin(angles)[:, None] * np.sin(rounds)).ravel(),
            (np.sin(angles)[:, None] * np.cos(rounds)).ravel(),
        ],
        axis=-1,
    )
    points = middle + radii * unit
    points = points[((points - centre) ** 2).sum(axis=1) <= (reach + margin) ** 2]
    rays = points - middle
    _slide(points, rays / np.linalg.norm(rays, axis=1)[:, None], surface, shape, waves)
    return np.asarray(points)


@compiled(nogil=True)
def _off(x: float, y: float, z: float, surface: int, shape: Array, waves: Array) -> float:
    return surface_distance(x, y, z, surface, shape, waves, _NO_PROBE)


@compiled(nogil=True)
def _slide(points: Array, directions: Array, surface: int, shape: Array, waves: Array) -> None:
    """Move points (n, 3) by at most ``_SLIDE`` along directions (n, 3) onto a surface; NaN if it is farther.

    The surface is bracketed and then met by false position, whose kept end is halved (Illinois).
    """
    for i in range(points.shape[0]):
        x, y, z = points[i]
        dx, dy, dz = directions[i]
        low, high = -_SLIDE, _SLIDE
        off_low = _off(x + low * dx, y + low * dy, z + low * dz, surface, shape, waves)
        off_high = _off(x + high * dx, y + high * dy, z + high * dz, surface, shape, waves)
        place, kept = np.nan, 0
        if off_low * off_high <= 0.0:
            for _ in range(80):
                place = (low * off_high - high * off_low) / (off_high - off_low)
                off = _off(x + place * dx, y + place * dy, z + place * dz, surface, shape, waves)
                if abs(off) < 1e-12 or high - low < 1e-13:
                    break
                if (off > 0.0) == (off_high > 0.0):
                    high, off_high = place, off
                    off_low = 0.5 * off_low if kept == 1 else off_low
                    kept = 1
                else:
                    low, off_low = place, off
                    off_high = 0.5 * off_high if kept == -1 else off_high
                    kept = -1
        points[i, 0], points[i, 1], points[i, 2] = x + place * dx, y + place * dy, z + place * dz


@compiled(nogil=True)
def _along_ridge(along: Array, shape: Array, waves: Array, points: Array) -> None:
    for i in range(len(along)):
        y, z, _, _ = ridge(along[i], shape, waves)
        points[i, 0], points[i, 1], points[i, 2] = along[i], y, z


@compiled(nogil=True)
def _on_meniscus(wedge: Array, shape: Array, waves: Array, faces: Array) -> None:
    """Points (3, n, 3) of the top, the back and the free edge of the meniscus; NaN where a face has ended.

    ``wedge`` (n, 2): place along the gap, and distance from the rim: before it on the top, below it on the
    back and the free edge.
    """
    slope, hollow, width, undercut = shape[22], shape[23], shape[24], shape[25]
    for i in range(wedge.shape[0]):
        x, s = wedge[i]
        rim_y, rim_z, _, _ = ridge(x, shape, waves)
        end = width - ripple(x, 0.0, 0.0, FREE_EDGE, shape, waves)
        if s <= end:
            below = _fall(x, s, rim_z, shape, waves, slope, hollow)
            faces[0, i, 0], faces[0, i, 1], faces[0, i, 2] = x, rim_y + below, rim_z - s
        faces[1, i, 0], faces[1, i, 1], faces[1, i, 2] = x, rim_y + s, rim_z - undercut * s
        if s > _fall(x, end, rim_z, shape, waves, slope, hollow):
            faces[2, i, 0], faces[2, i, 1], faces[2, i, 2] = x, rim_y + s, rim_z - end


@compiled(nogil=True)
def _fall(
    x: float, before: float, rim_z: float, shape: Array, waves: Array, slope: float, hollow: float
) -> float:
    """Depth of the top of the meniscus below the rim, at a distance before it."""
    fall = slope * before - hollow * before * before
    if before > 0.0:
        fall -= ripple(x, 0.0, rim_z - before, MENISCUS, shape, waves) * before / (before + 0.5e-3)
    return float(fall)
