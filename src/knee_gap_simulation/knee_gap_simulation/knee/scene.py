"""The scene of a knee of known gap: condyle, plateau, meniscus and the wall of the joint behind.

Scene frame: x along the gap, y across it (the femur at negative y), z away from the lens; the origin lies
in the middle of the gap, at the depth of the sharp rim of the meniscus. The upper edge of the dark gap is
the occluding contour of the condyle, the lower one the rim of the meniscus with the recess behind it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.surfaces import distance_field as fields
from knee_gap_simulation.surfaces import ray_marching as rays
from knee_gap_simulation.surfaces.distance_field import CAPSULE, CONDYLE, MENISCUS, PLATEAU, PROBE
from knee_gap_simulation.surfaces.tissue_samples import TissueSamples, angles_off, knee_samples

KIND = "knee"
NO_PROBE = np.zeros((0, 4))
ANY = -1

# The nearest distance is searched within this distance of the middle of the gap, where an instrument passes.
NEAREST_WITHIN = 0.006

# A closed joint: the condyle rests on the meniscus.
CLOSED = -0.0012
# A point deeper than this behind the rim is seen through the gap.
_BEHIND = 0.0035
# Distance from the middle of the gap within which its edges are searched [m].
_EDGE_WITHIN = 0.018

Vector = tuple[float, float, float]
Wave = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class KneeScene:
    """The shape of a knee, fully determined by these numbers. Lengths [m].

    ``gap`` is the nearest distance between the condyle and the tissue below it; `None` for a closed joint.
    ``waves`` are the ripples of the surfaces, as `knee_field` reads them.
    """

    gap: float | None
    seed: int
    waves: tuple[Wave, ...]
    condyle_centre: Vector
    condyle_radii: Vector
    capsule_centre: Vector = (0.0, 0.0, 0.001)
    capsule_radii: Vector = (0.021, 0.017, 0.027)
    plateau_below_rim: float = 0.0030
    plateau_tilt: tuple[float, float] = (0.0, 0.12)
    plateau_bend: float = 4.0
    plateau_front: float = -0.003
    plateau_fall: float = 90.0
    rim_height: float = 0.0
    rim_depth: float = 0.0
    rim_bend_y: float = 55.0
    rim_bend_z: float = 30.0
    wedge_slope: float = 0.95
    wedge_hollow: float = 55.0
    wedge_width: float = 0.0043
    wedge_undercut: float = 0.25

    @staticmethod
    def random(gap: float | None, seed: int, roughness: float = 1.0) -> "KneeScene":
        """A knee with a given gap [m], or a closed one; ``roughness`` scales the unevenness of its surfaces.

        The same seed gives the same knee.
        """
        if gap is not None and not 0.001 <= gap <= 0.012:
            raise SimulationError(f"the gap must lie in [1, 12] mm, not {1e3 * gap:g} mm")
        rng = np.random.default_rng([seed, 0x4B4E])
        radii = (rng.uniform(0.024, 0.030), rng.uniform(0.019, 0.023), rng.uniform(0.017, 0.021))
        wanted = CLOSED if gap is None else gap
        below = 0.5 * max(wanted, 0.002)
        tilt = (rng.uniform(-0.08, 0.08), rng.uniform(0.08, 0.15))
        scene = KneeScene(
            gap=gap,
            seed=seed,
            waves=_waves(rng, roughness),
            condyle_centre=(rng.uniform(-0.002, 0.002), -radii[1] - below, rng.uniform(0.0028, 0.0042)),
            condyle_radii=radii,
            plateau_tilt=tilt,
            rim_height=below,
            rim_bend_y=1.0 / radii[0] + rng.uniform(-8.0, 6.0),
            rim_bend_z=rng.uniform(18.0, 36.0),
            wedge_slope=rng.uniform(0.85, 1.05),
            capsule_radii=(rng.uniform(0.0165, 0.0195), 0.017, rng.uniform(0.029, 0.033)),
        )
        return scene._opened_to(wanted)

    def as_dict(self) -> dict[str, Any]:
        """The knee as plain values for JSON."""
        return {"kind": KIND, **{name: getattr(self, name) for name in self.__dataclass_fields__}}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "KneeScene":
        """The knee of `as_dict`."""
        fields_ = {name: value for name, value in values.items() if name != "kind"}
        fields_["waves"] = tuple(tuple(wave) for wave in fields_["waves"])
        for name, value in fields_.items():
            if isinstance(value, list):
                fields_[name] = tuple(value)
        return KneeScene(**fields_)

    def constants(self) -> Array:
        """The shape as `knee_field` reads it."""
        amplitudes = {
            kind: sum(wave[1] for wave in self.waves if wave[0] == kind)
            for kind in (fields.RIDGE_HEIGHT, fields.RIDGE_DEPTH, MENISCUS)
        }
        highest = self.rim_height - amplitudes[fields.RIDGE_HEIGHT] - amplitudes[MENISCUS]
        # The rim rises to the sides: its bound is at the end of the joint.
        highest -= 0.5 * self.rim_bend_y * self.capsule_radii[0] ** 2
        farthest = self.rim_depth + amplitudes[fields.RIDGE_DEPTH]
        return np.array(
            [
                *self.condyle_centre,
                *self.condyle_radii,
                *self.capsule_centre,
                *self.capsule_radii,
                self.rim_height + self.plateau_below_rim,
                *self.plateau_tilt,
                self.plateau_bend,
                self.plateau_front,
                self.plateau_fall,
                self.rim_height,
                self.rim_depth,
                self.rim_bend_y,
                self.rim_bend_z,
                self.wedge_slope,
                self.wedge_hollow,
                self.wedge_width,
                self.wedge_undercut,
                highest,
                farthest,
                *np.searchsorted([wave[0] for wave in self.waves], np.arange(9.0)),
            ]
        )

    def wave_array(self) -> Array:
        """The ripples (n, 6) as `knee_field` reads them."""
        return np.array(self.waves)

    def distance(self, points: npt.ArrayLike, surface: int = ANY) -> Array:
        """Distance (n,) of points (n, 3) to a surface or the nearest: exact on it, at most the true one."""
        places = np.ascontiguousarray(np.asarray(points, dtype=np.float64).reshape(-1, 3))
        result = np.empty(len(places))
        fields.distances(places, surface, self.constants(), self.wave_array(), NO_PROBE, result)
        return result

    def surface_points(self, T_scene_lens: Array, bearings: Array, probe: Array | None = None) -> Array:
        """Points (n, 3) of the scene behind bearings (n, 3) of a lens; NaN if there are none."""
        directions = bearings @ T_scene_lens[:3, :3].T
        return self.cast(T_scene_lens[:3, 3], directions, probe)[0]

    def cast(
        self,
        origin: Array,
        directions: Array,
        probe: Array | None = None,
        *,
        starts: Array | None = None,
        exact: bool = True,
    ) -> tuple[Array, Array, npt.NDArray[np.uint8], Array]:
        """First surface along rays from one origin (3,) in unit directions (n, 3), in the scene frame.

        Returns points (n, 3), normals (n, 3) out of the tissue, surfaces (n,), 255 and NaN if nothing is
        hit, and the lengths (n,) of the rays. Each ray is known to be free up to ``starts`` (n,).
        """
        count = len(directions)
        lengths, normals = np.empty(count), np.empty((count, 3))
        surfaces = np.empty(count, np.uint8)
        rays.cast(
            np.ascontiguousarray(origin),
            np.ascontiguousarray(directions),
            np.zeros(count) if starts is None else starts,
            exact,
            self.constants(),
            self.wave_array(),
            NO_PROBE if probe is None else probe,
            lengths,
            surfaces,
            normals,
        )
        return origin + lengths[:, None] * directions, normals, surfaces, lengths

    def looks_into_gap(
        self, T_scene_lens: Array, bearings: Array, probe: Array | None = None
    ) -> npt.NDArray[np.bool_]:
        """Whether bearings (n, 3) of a lens look into the gap."""
        directions = bearings @ T_scene_lens[:3, :3].T
        points, _, surfaces, _ = self.cast(T_scene_lens[:3, 3], directions, probe, exact=False)
        return self.is_gap(points, surfaces)

    def is_gap(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Whether points (n, 3) on surfaces (n,) were seen through the gap."""
        # NaN compares as false: a ray that hits nothing is not in the gap.
        behind = points[:, 2] > self.rim_depth - 0.5 * self.rim_bend_z * points[:, 0] ** 2 + _BEHIND
        return np.asarray(behind & np.isin(surfaces, (PLATEAU, CAPSULE, MENISCUS)))

    def uv(self, points: Array, surfaces: npt.NDArray[np.uint8]) -> Array:
        """Coordinates (n, 2) [m] on the surface of points (n, 3), for the textures."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        uv = np.stack([x, z], axis=-1)
        on = surfaces == CONDYLE
        _, cy, cz = self.condyle_centre
        uv[on, 1] = 0.021 * np.arctan2(z[on] - cz, y[on] - cy)
        on = surfaces == MENISCUS
        # Down the slope of the wedge, and down its blunt free edge.
        uv[on, 1] = 0.7 * (z[on] + 0.5 * self.rim_bend_z * x[on] ** 2 - y[on])
        on = surfaces == CAPSULE
        uv[on, 0] = 0.018 * np.arctan2(x[on], z[on])
        uv[on, 1] = y[on]
        on = surfaces == PROBE
        uv[on] = 3.0 * np.stack([x[on] + z[on], y[on]], axis=-1)
        return np.asarray(uv)

    def ridge(self, along: npt.ArrayLike) -> Array:
        """Points (n, 3) of the sharp rim of the meniscus at places (n,) along the gap."""
        places = np.atleast_1d(np.asarray(along, dtype=np.float64))
        result = np.empty((len(places), 3))
        fields.ridge_points(places, self.constants(), self.wave_array(), result)
        return result

    def tissue_samples(self, centre: Array, reach: float) -> TissueSamples:
        """Points on condyle, plateau, meniscus and capsule within ``reach`` [m] of a centre (3,)."""
        return knee_samples(self.constants(), self.wave_array(), centre, reach)

    def contacts(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Points (2, 3) of the condyle and of the rim of the meniscus to which a line of sight comes closest.

        A line that cuts the condyle comes closest where it is deepest. The angles (2,) [rad] between the line
        and the points follow.
        """
        along = np.linspace(-_EDGE_WITHIN, _EDGE_WITHIN, 2001)
        index = int(np.argmin(angles_off(origin, direction, self.ridge(along))))
        step = float(along[1] - along[0])
        place = minimize_scalar(
            lambda x: angles_off(origin, direction, self.ridge(float(x)))[0],
            bounds=(along[index] - step, along[index] + step),
            method="bounded",
            options={"xatol": 1e-9},
        )
        reached = np.linspace(1e-3, 0.03, 600)
        depths = self.distance(origin + reached[:, None] * direction, CONDYLE)
        index = int(np.argmin(depths))
        nearest = minimize_scalar(
            lambda t: float(self.distance(origin + t * direction, CONDYLE)[0]),
            bounds=(reached[max(0, index - 1)], reached[min(len(reached) - 1, index + 1)]),
            method="bounded",
            options={"xatol": 1e-9},
        )
        foot = np.empty(3)
        fields.foot_on_condyle(origin + nearest.x * direction, self.constants(), self.wave_array(), foot)
        points = np.stack([foot, self.ridge(float(place.x))[0]])
        return points, angles_off(origin, direction, points)

    def nearest_distance(self) -> tuple[float, Array, Array]:
        """Smallest distance between the condyle and the tissue below it, and the points (3,) where it is.

        Within ``NEAREST_WITHIN`` of the middle of the gap; negative where the joint is closed: how deep
        they meet. The rim of the meniscus is the highest place of what lies below, so it is searched along
        the rim.
        """
        along = np.linspace(-NEAREST_WITHIN, NEAREST_WITHIN, 31)
        heights = np.array([self._above(float(x))[0] for x in along])
        step = float(along[1] - along[0])
        found = []
        for index in np.argsort(heights)[:3]:
            low, high = np.clip([along[index] - step, along[index] + step], -NEAREST_WITHIN, NEAREST_WITHIN)
            place = minimize_scalar(
                lambda x: self._above(float(x))[0],
                bounds=(low, high),
                method="bounded",
                options={"xatol": 1e-8},
            )
            found.append((float(place.fun), float(place.x)))
        return self._above(min(found)[1])

    def _above(self, x: float) -> tuple[float, Array, Array]:
        """Distance from the rim at x to the condyle, negative inside it, the rim's point and its foot."""
        point, foot = self.ridge(x)[0], np.empty(3)
        fields.foot_on_condyle(point, self.constants(), self.wave_array(), foot)
        sign = -1.0 if self.distance(point, CONDYLE)[0] < 0.0 else 1.0
        return sign * float(np.linalg.norm(point - foot)), point, foot

    def opened(self) -> "KneeScene":
        """The same knee with the condyle raised or lowered until the nearest distance is the gap."""
        return self._opened_to(CLOSED if self.gap is None else self.gap)

    def _opened_to(self, gap: float) -> "KneeScene":
        """The same knee with the condyle raised or lowered until the nearest distance is ``gap``."""
        scene = self
        for _ in range(30):
            excess = gap - scene.nearest_distance()[0]
            if abs(excess) < 1e-9:
                break
            x, y, z = scene.condyle_centre
            scene = replace(scene, condyle_centre=(x, y - excess, z))
        return scene


def _waves(rng: np.random.Generator, roughness: float) -> tuple[Wave, ...]:
    """Ripples of every surface: (surface, [(wavelength, amplitude), ...]) in random directions and phases."""
    plans: tuple[tuple[int, tuple[tuple[float, float], ...]], ...] = (
        (CONDYLE, ((11e-3, 0.16e-3), (7e-3, 0.09e-3), (4.5e-3, 0.045e-3), (2.8e-3, 0.018e-3))),
        (PLATEAU, ((9e-3, 0.14e-3), (5e-3, 0.06e-3), (3e-3, 0.025e-3))),
        (MENISCUS, ((5e-3, 0.06e-3), (2.2e-3, 0.03e-3), (1.3e-3, 0.012e-3))),
        (CAPSULE, ((10e-3, 0.7e-3), (6e-3, 0.35e-3), (3e-3, 0.14e-3))),
        (fields.RIDGE_HEIGHT, ((9e-3, 0.12e-3), (3.3e-3, 0.035e-3), (1.1e-3, 0.010e-3), (0.6e-3, 0.006e-3))),
        (fields.RIDGE_DEPTH, ((8e-3, 0.20e-3), (2.9e-3, 0.06e-3), (1.2e-3, 0.02e-3))),
        (fields.FREE_EDGE, ((7e-3, 0.25e-3), (2.6e-3, 0.06e-3), (0.9e-3, 0.012e-3))),
    )
    waves: list[Wave] = []
    for surface, plan in plans:
        for length, amplitude in plan:
            heading = rng.standard_normal(3)
            if surface in (fields.RIDGE_HEIGHT, fields.RIDGE_DEPTH, fields.FREE_EDGE):
                heading = np.array([1.0, 0.0, 0.0])
            u, v, w = heading / (length * rng.uniform(0.8, 1.25) * np.linalg.norm(heading))
            scale = 1.0 if surface == CAPSULE else roughness
            phase = rng.uniform(0.0, 1.0)
            waves.append((float(surface), amplitude * scale, float(u), float(v), float(w), phase))
    return tuple(waves)
