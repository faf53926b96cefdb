"""Surface point of every pixel by ray casting: a coarse grid of rays, interpolated on smooth surfaces."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.scene import NO_PROBE, KneeScene
from knee_gap_simulation.surfaces import distance_field as fields
from knee_gap_simulation.surfaces import ray_marching as rays

Bytes = npt.NDArray[np.uint8]
NOTHING = np.uint8(255)
SPACING_PX = 4
# A cell is interpolated if its corners lie on one surface, are clearly visible and almost in one plane.
_LEAST_FACING = 0.12
_MOST_STRETCH = 1.10
_LEAST_AGREEMENT = 0.985
# The joint's wall is rough, far and dark: a coarser tolerance is enough.
_LEAST_AGREEMENT_OF_WALL = 0.93
# Side of the blocks whose cones are tried first, in coarse cells.
_BLOCK = 4


class SurfaceMap(NamedTuple):
    """Surface behind every pixel (h, w): ray length, surface, normal, light of the lamp and ambient light."""

    lengths: Array
    surfaces: Bytes
    normals: Array
    reach: Array


class SurfaceMapper:
    """Casts the rays of a fixed grid of bearings (h, w, 3), NaN outside the picture, into a knee."""

    def __init__(self, scene: KneeScene, bearings: Array) -> None:
        self._scene = scene
        self._bearings = bearings
        self._shape = bearings.shape[:2]
        rows = np.unique(np.append(np.arange(0, self._shape[0], SPACING_PX), self._shape[0] - 1))
        columns = np.unique(np.append(np.arange(0, self._shape[1], SPACING_PX), self._shape[1] - 1))
        self._rows, self._columns = rows, columns
        self._coarse = np.ascontiguousarray(bearings[np.ix_(rows, columns)])
        self._cones, self._spread, self._cone_of = _cones(self._coarse)
        self._constants, self._waves = scene.constants(), scene.wave_array()

    def map(self, T_scene_lens: Array, lamp: Array, probe: Array | None = None) -> SurfaceMap:
        """Surfaces behind all pixels at a lens pose, lit from ``lamp`` (3,) in the scene."""
        rods = NO_PROBE if probe is None else probe
        origin, turn = np.ascontiguousarray(T_scene_lens[:3, 3]), T_scene_lens[:3, :3]
        free = np.empty(len(self._cones))
        directions = np.ascontiguousarray(self._cones @ turn.T)
        rays.free_lengths(origin, directions, self._spread, self._constants, self._waves, rods, free)
        coarse = self._trace(origin, self._coarse.reshape(-1, 3) @ turn.T, free[self._cone_of], lamp, rods)
        grid = self._coarse.shape[:2]
        facing = -np.einsum("ijk,ijk->ij", coarse[2].reshape(*grid, 3), self._coarse @ turn.T)
        lengths = np.full(self._shape, np.nan)
        surfaces = np.full(self._shape, NOTHING, np.uint8)
        normals = np.zeros((*self._shape, 3))
        reach = np.ones((*self._shape, 2))
        starts = np.full(self._shape, -1.0)
        _fill(
            self._rows,
            self._columns,
            coarse[0].reshape(grid),
            coarse[1].reshape(grid),
            coarse[2].reshape(*grid, 3),
            coarse[3].reshape(*grid, 2),
            facing,
            lengths,
            surfaces,
            normals,
            reach,
            starts,
        )
        todo = (starts >= 0.0) & np.isfinite(self._bearings[..., 0])
        fine = self._trace(origin, self._bearings[todo] @ turn.T, starts[todo], lamp, rods)
        lengths[todo], surfaces[todo], normals[todo], reach[todo] = fine
        return SurfaceMap(lengths, surfaces, normals, reach)

    def _trace(
        self,
        origin: Array,
        directions: Array,
        starts: Array,
        lamp: Array,
        probe: Array,
    ) -> tuple[Array, Bytes, Array, Array]:
        """Lengths, surfaces, normals and reach of light of rays, each free from its start."""
        count = len(directions)
        lengths, surfaces = np.empty(count), np.empty(count, np.uint8)
        normals, reach = np.empty((count, 3)), np.empty((count, 2))
        knee = self._constants, self._waves, probe
        rays.cast(origin, np.ascontiguousarray(directions), starts, False, *knee, lengths, surfaces, normals)
        points = origin + lengths[:, None] * directions
        rays.light_reach(points, normals, lamp, *knee, reach)
        return lengths, surfaces, normals, reach


def _cones(bearings: Array) -> tuple[Array, float, npt.NDArray[np.int64]]:
    """Axes (k, 3) of cones around blocks of bearings (h, w, 3), their half angle, each bearing's cone."""
    height, width = bearings.shape[:2]
    rows, columns = np.arange(height) // _BLOCK, np.arange(width) // _BLOCK
    cone_of = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    flat = bearings.reshape(-1, 3)
    seen = np.isfinite(flat[:, 0])
    sums = np.zeros((cone_of.max() + 1, 3))
    np.add.at(sums, cone_of[seen], flat[seen])
    # A block outside the field of view has no cone; its axis does not matter.
    sums[~sums.any(axis=1)] = (0.0, 0.0, 1.0)
    axes = sums / np.linalg.norm(sums, axis=1)[:, None]
    cosine = np.einsum("ij,ij->i", axes[cone_of], flat)[seen].min()
    return axes, float(np.arccos(cosine)), cone_of


@compiled(nogil=True)
def _fill(
    rows: npt.NDArray[np.int64],
    columns: npt.NDArray[np.int64],
    coarse_lengths: Array,
    coarse_surfaces: Bytes,
    coarse_normals: Array,
    coarse_reach: Array,
    facing: Array,
    lengths: Array,
    surfaces: Bytes,
    normals: Array,
    reach: Array,
    starts: Array,
) -> None:
    """Interpolate the cells whose corners agree; for the others return the start of each pixel's ray."""
    last_row, last_column = rows.shape[0] - 2, columns.shape[0] - 2
    for i in range(last_row + 1):
        for j in range(last_column + 1):
            surface = coarse_surfaces[i, j]
            shortest, longest = np.inf, 0.0
            agree, seen = surface != 255, False
            least = _LEAST_AGREEMENT_OF_WALL if surface == fields.CAPSULE else _LEAST_AGREEMENT
            for a in range(2):
                for b in range(2):
                    length = coarse_lengths[i + a, j + b]
                    if not np.isfinite(length):
                        agree = False
                        continue
                    seen = True
                    shortest, longest = min(shortest, length), max(longest, length)
                    dot = 0.0
                    for k in range(3):
                        dot += coarse_normals[i, j, k] * coarse_normals[i + a, j + b, k]
                    if (
                        coarse_surfaces[i + a, j + b] != surface
                        or facing[i + a, j + b] < _LEAST_FACING
                        or not dot > least
                    ):
                        agree = False
            if longest > _MOST_STRETCH * shortest:
                agree = False
            last = rows[i + 1] + (1 if i == last_row else 0)
            end = columns[j + 1] + (1 if j == last_column else 0)
            for row in range(rows[i], last):
                for column in range(columns[j], end):
                    if not agree:
                        starts[row, column] = 0.7 * shortest if seen else 0.0
                        continue
                    v = (row - rows[i]) / (rows[i + 1] - rows[i])
                    u = (column - columns[j]) / (columns[j + 1] - columns[j])
                    w00, w01 = (1.0 - v) * (1.0 - u), (1.0 - v) * u
                    w10, w11 = v * (1.0 - u), v * u
                    surfaces[row, column] = surface
                    lengths[row, column] = (
                        w00 * coarse_lengths[i, j]
                        + w01 * coarse_lengths[i, j + 1]
                        + w10 * coarse_lengths[i + 1, j]
                        + w11 * coarse_lengths[i + 1, j + 1]
                    )
                    total = 0.0
                    for k in range(3):
                        part = (
                            w00 * coarse_normals[i, j, k]
                            + w01 * coarse_normals[i, j + 1, k]
                            + w10 * coarse_normals[i + 1, j, k]
                            + w11 * coarse_normals[i + 1, j + 1, k]
                        )
                        normals[row, column, k] = part
                        total += part * part
                    for k in range(3):
                        normals[row, column, k] /= np.sqrt(total)
                    for k in range(2):
                        reach[row, column, k] = (
                            w00 * coarse_reach[i, j, k]
                            + w01 * coarse_reach[i, j + 1, k]
                            + w10 * coarse_reach[i + 1, j, k]
                            + w11 * coarse_reach[i + 1, j + 1, k]
                        )
