"""The simple scene: two wet leaves of tissue with sharp rims and a dark gap between them.

Scene frame: x along the gap, y across it, z away from the lens; the origin is the middle of the gap on the
plane of the rims. Each leaf is a height field z = f(x, y) that ends at a wavy rim and hides its own
underside; behind the gap lies a cavity with a far wall. Every ray's intersection is found to rounding, so
the truth is exact by construction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.surfaces.textures import FloatImage, Tissue, tissue_texture
from knee_gap_simulation.surfaces.tissue_samples import (
    LOWER_SIDE,
    RIM_SPACING,
    SPACING,
    UPPER_SIDE,
    TissueSamples,
    angles_off,
    joined,
    steps,
)

KIND = "rims"
UPPER, LOWER, WALL = 0, 1, 2
# Distance from the middle of the gap within which its edges are searched [m].
_EDGE_WITHIN = 0.018

_TISSUES = (
    Tissue((232, 214, 196), (226, 170, 150), 0.35, mottle=0.07, grain=0.09, fibres=0.03, vessels=8),
    Tissue((228, 208, 180), (220, 160, 130), 0.40, mottle=0.07, grain=0.09, fibres=0.04, vessels=5),
    Tissue((110, 30, 26), (60, 14, 14), 0.6, mottle=0.25, grain=0.08, relief=0.06, gloss=0.05),
)


@dataclass(frozen=True)
class RimScene:
    """The scene, fully determined by these numbers. Lengths [m].

    ``gap`` is the nominal distance of the rims at x = 0, their widest place; away from it the gap narrows
    to ``end_share`` of it over ``opening``. Each wave is (side, amplitude, wave number u, v, phase): side 0
    or 1 for the height of the upper or lower leaf, 2 or 3 for the place of their rims (v unused).
    """

    gap: float
    seed: int
    waves: tuple[tuple[float, float, float, float, float], ...]
    end_share: float = 0.65
    opening: float = 0.009
    slope: float = 0.30
    bend: float = 25.0
    wall: float = 0.028

    @staticmethod
    def random(gap: float, seed: int) -> "RimScene":
        """A scene of a given gap [m]; the same seed gives the same scene."""
        if not 0.001 <= gap <= 0.015:
            raise SimulationError(f"the gap must lie in [1, 15] mm, not {1e3 * gap:g} mm")
        rng = np.random.default_rng([seed, 0x5253])
        waves = []
        for side in (0, 1):
            for length, amplitude in (
                (0.009, 0.25e-3),
                (0.006, 0.15e-3),
                (0.0035, 0.05e-3),
                (0.0022, 0.02e-3),
            ):
                heading = rng.uniform(0.0, np.pi)
                number = 2.0 * np.pi / (length * rng.uniform(0.8, 1.25))
                u, v = number * np.cos(heading), number * np.sin(heading)
                waves.append((float(side), amplitude, u, v, rng.uniform(0.0, 2.0 * np.pi)))
        for side in (2, 3):
            for length, amplitude in ((0.008, 0.10e-3), (0.0031, 0.05e-3), (0.0012, 0.02e-3)):
                number = 2.0 * np.pi / (length * rng.uniform(0.8, 1.25))
                waves.append((float(side), amplitude, number, 0.0, rng.uniform(0.0, 2.0 * np.pi)))
        return RimScene(gap=gap, seed=seed, waves=tuple(waves))

    def as_dict(self) -> dict[str, Any]:
        """The scene as plain values for JSON."""
        return {"kind": KIND, **{name: getattr(self, name) for name in self.__dataclass_fields__}}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "RimScene":
        """The scene of `as_dict`."""
        fields = {name: value for name, value in values.items() if name != "kind"}
        fields["waves"] = tuple(tuple(wave) for wave in fields["waves"])
        return RimScene(**fields)

    def textures(self) -> FloatImage:
        """Textures (3, size, size, channels) of the upper leaf, the lower leaf and the wall."""
        rng = np.random.default_rng([self.seed, 0x5458])
        return np.stack([tissue_texture(tissue, rng) for tissue in _TISSUES])

    def cast(self, origin: Array, directions: Array) -> tuple[Array, Array, Array, Any]:
        """First surface along rays from one origin (3,) in unit directions (n, 3), all in the scene frame.

        Returns points (n, 3), normals (n, 3) towards the lens, uv (n, 2) [m] and surfaces (n,); points are
        NaN and surfaces NOTHING if nothing is hit or the direction is NaN.
        """
        count = len(directions)
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        uv, surfaces = np.empty((count, 2)), np.empty(count, np.uint8)
        _cast(origin, directions, self._constants(), np.array(self.waves), points, normals, uv, surfaces)
        return points, normals, uv, surfaces

    def surface_points(self, T_scene_lens: Array, bearings: Array) -> Array:
        """Points (n, 3) of the scene behind bearings (n, 3) of a lens; NaN if there are none."""
        directions = bearings @ T_scene_lens[:3, :3].T
        return self.cast(T_scene_lens[:3, 3].copy(), np.ascontiguousarray(directions))[0]

    def rim(self, x: npt.ArrayLike) -> tuple[Array, Array]:
        """Points (n, 3) of the upper and of the lower rim at places x (n,) along the gap."""
        along = np.atleast_1d(np.asarray(x, dtype=np.float64))
        constants, waves = self._constants(), np.array(self.waves)
        rims = []
        for side in (UPPER, LOWER):
            y = np.array([_rim(at, side, constants, waves) for at in along])
            z = np.array(
                [_height(at, to, side, constants, waves)[0] for at, to in zip(along, y, strict=True)]
            )
            rims.append(np.stack([along, y, z], axis=-1))
        return rims[0], rims[1]

    def tissue_samples(self, centre: Array, reach: float) -> TissueSamples:
        """Points on both leaves and along their rims within ``reach`` [m] of a centre (3,)."""
        rims = self.rim(steps(centre[0] - reach, centre[0] + reach, RIM_SPACING))
        parts = [(UPPER_SIDE, rims[0]), (LOWER_SIDE, rims[1])]
        along = steps(centre[0] - reach, centre[0] + reach, SPACING)
        outward = steps(0.0, reach, SPACING)
        for side, sign, edge in zip((UPPER, LOWER), (-1.0, 1.0), self.rim(along), strict=True):
            flat = np.stack(np.broadcast_arrays(along[:, None], edge[:, 1:2] + sign * outward), axis=-1)
            leaf = np.empty((flat.shape[0] * flat.shape[1], 3))
            leaf[:, :2] = flat.reshape(-1, 2)
            _lift(leaf, side, self._constants(), np.array(self.waves))
            parts.append((UPPER_SIDE if side == UPPER else LOWER_SIDE, leaf))
        return joined(parts, centre, reach)

    def contacts(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Points (2, 3) of the upper and the lower rim to which a line of sight comes closest, as an angle.

        The angles (2,) [rad] between the line and the points follow.
        """
        points, angles = np.empty((2, 3)), np.empty(2)
        for side in (UPPER, LOWER):
            begin, end = -_EDGE_WITHIN, _EDGE_WITHIN
            for _ in range(4):
                along = np.linspace(begin, end, 601)
                rim = self.rim(along)[side]
                off = angles_off(origin, direction, rim)
                index = int(off.argmin())
                begin, end = along[max(0, index - 2)], along[min(len(along) - 1, index + 2)]
            points[side], angles[side] = rim[index], off[index]
        return points, angles

    def looks_into_gap(self, T_scene_lens: Array, bearings: Array) -> npt.NDArray[np.bool_]:
        """Whether bearings (n, 3) of a lens look into the gap."""
        directions = np.ascontiguousarray(bearings @ T_scene_lens[:3, :3].T)
        return np.asarray(self.cast(T_scene_lens[:3, 3].copy(), directions)[3] == WALL)

    def _constants(self) -> Array:
        return np.array([self.gap, self.end_share, self.opening, self.slope, self.bend, self.wall])


@compiled
def _rim(x: float, side: int, constants: Array, waves: Array) -> float:
    """Rim of a leaf: its y at a position x along the gap."""
    gap, end_share, opening = constants[0], constants[1], constants[2]
    half = 0.5 * gap * (end_share + (1.0 - end_share) * np.exp(-((x / opening) ** 2)))
    y = -half if side == 0 else half
    for k in range(waves.shape[0]):
        if waves[k, 0] == side + 2:
            y += waves[k, 1] * np.sin(waves[k, 2] * x + waves[k, 4])
    return float(y)


@compiled
def _height(x: float, y: float, side: int, constants: Array, waves: Array) -> tuple[float, float, float]:
    """Height of a leaf over the plane of the rims, and its slopes along x and y."""
    slope, bend = constants[3], constants[4]
    sign = -1.0 if side == 0 else 1.0
    out = sign * y
    # The leaves rise towards the lens away from the gap, less and less.
    z = -slope * out + bend * out * out * 0.5
    dz_dx, dz_dy = 0.0, sign * (-slope + bend * out)
    for k in range(waves.shape[0]):
        if waves[k, 0] == side:
            phase = waves[k, 2] * x + waves[k, 3] * y + waves[k, 4]
            z += waves[k, 1] * np.sin(phase)
            change = waves[k, 1] * np.cos(phase)
            dz_dx += waves[k, 2] * change
            dz_dy += waves[k, 3] * change
    return z, dz_dx, dz_dy


@compiled
def _lift(points: Array, side: int, constants: Array, waves: Array) -> None:
    """Set the heights z of points (n, 3) so that they lie on a leaf."""
    for i in range(points.shape[0]):
        points[i, 2] = _height(points[i, 0], points[i, 1], side, constants, waves)[0]


@compiled
def _cast(
    origin: Array,
    directions: Array,
    constants: Array,
    waves: Array,
    points: Array,
    normals: Array,
    uv: Array,
    surfaces: npt.NDArray[np.uint8],
) -> None:
    wall = constants[5]
    least = 0.5 * constants[0] * constants[1]
    for k in range(waves.shape[0]):
        if waves[k, 0] >= 2:
            least -= waves[k, 1]
    # Neighbouring rays meet a leaf at nearly the same distance.
    guess = np.full(2, -1.0)
    for i in range(len(directions)):
        dx, dy, dz = directions[i]
        surfaces[i] = 255
        for k in range(3):
            points[i, k] = np.nan
            normals[i, k] = np.nan
        uv[i, 0] = uv[i, 1] = 0.0
        if not dz > 0.05:
            continue
        nearest = np.inf
        for side in range(2):
            # y changes one way along a ray: one that starts inside the gap meets only the leaf it heads for.
            sign = -1.0 if side == 0 else 1.0
            if sign * dy <= 0.0 and sign * origin[1] <= least:
                continue
            t = guess[side]
            if not t > 0.0:
                t = -origin[2] / dz
            slope_x = slope_y = 0.0
            step = np.inf
            for _ in range(40):
                x, y = origin[0] + t * dx, origin[1] + t * dy
                z, slope_x, slope_y = _height(x, y, side, constants, waves)
                step = (origin[2] + t * dz - z) / (dz - slope_x * dx - slope_y * dy)
                t -= step
                if abs(step) < 1e-9:  # Newton squares the error: what is left is rounding
                    break
            guess[side] = t if abs(step) < 1e-9 else -1.0
            if not (abs(step) < 1e-9 and 0.0 < t < nearest):
                continue
            x, y = origin[0] + t * dx, origin[1] + t * dy
            rim = _rim(x, side, constants, waves)
            if (side == 0 and y > rim) or (side == 1 and y < rim):
                continue
            nearest = t
            surfaces[i] = side
            scale = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
            points[i, 0], points[i, 1], points[i, 2] = x, y, origin[2] + t * dz
            normals[i, 0], normals[i, 1], normals[i, 2] = slope_x * scale, slope_y * scale, -scale
            uv[i, 0], uv[i, 1] = x, y
        if surfaces[i] == 255:
            t = (wall - origin[2]) / dz
            surfaces[i] = 2
            points[i, 0], points[i, 1], points[i, 2] = origin[0] + t * dx, origin[1] + t * dy, wall
            normals[i, 0], normals[i, 1], normals[i, 2] = 0.0, 0.0, -1.0
            uv[i, 0], uv[i, 1] = points[i, 0], points[i, 1]
