"""Surface meshes of a knee from files: by name, in metres, checked."""

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.user_files import FileError, open_file
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.errors import SimulationError

SUFFIXES = (".stl", ".ply", ".obj")
UNITS = {"m": 1.0, "mm": 1e-3}
_MOST_BYTES = 256 << 20
# Width of a femur's cartilage across the knee [m].
_WIDTHS = (0.04, 0.12)
_LEAST_FACES = 4

Faces = npt.NDArray[np.int64]


class Surface(NamedTuple):
    """Triangles: vertices (n, 3) [m] and faces (m, 3), counter-clockwise seen from outside the tissue."""

    vertices: Array
    faces: Faces

    def moved(self, T_a_b: Array) -> "Surface":
        """The same surface, of frame b, in frame a."""
        return Surface(self.vertices @ T_a_b[:3, :3].T + T_a_b[:3, 3], self.faces)

    @property
    def corners(self) -> Array:
        """Corners (m, 3, 3) of the triangles."""
        return np.asarray(self.vertices[self.faces])

    @staticmethod
    def joined(parts: "list[Surface]") -> "Surface":
        """All triangles of several surfaces."""
        if not parts:
            return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
        return Surface(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


@dataclass(frozen=True, eq=False)
class KneeMeshes:
    """The meshes of one knee: x forward, y up along the leg, z to the right of the person, in metres.

    ``lateral`` is 1 if the lateral side lies at positive z (a right knee), else -1; ``digest`` of the files.
    """

    femur: Surface
    tibia: Surface
    menisci: tuple[Surface, ...]
    lateral: int
    digest: str


def read_meshes(folder: Path, unit: str = "m") -> KneeMeshes:
    """The meshes in a folder, by their names. Raises SimulationError or FileError if they make no knee."""
    if not folder.is_dir():
        raise SimulationError(f"{folder} is no folder of meshes")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    found: dict[str, Path] = {}
    for path in files:
        role = _role(path.stem)
        if role is None:
            continue
        if role in found:
            raise SimulationError(f"{folder} holds two meshes of the {role}: {found[role].name}, {path.name}")
        found[role] = path
    for role in ("femur", "tibia"):
        if role not in found:
            raise SimulationError(f"{folder} holds no mesh (STL, PLY, OBJ) whose name contains '{role}'")
    surfaces = {role: _read(path, UNITS[unit]) for role, path in found.items()}
    _check_size(surfaces["femur"], found["femur"], unit)
    for role, surface in surfaces.items():
        _check_holes(surface, found[role])
    _check_places(surfaces, found)
    _check_sides(surfaces, found)
    digest = sha256()
    for role in sorted(found):
        with open_file(found[role]) as file:
            digest.update(role.encode() + file.read(_MOST_BYTES))
    menisci = {role: surface for role, surface in surfaces.items() if "meniscus" in role}
    return KneeMeshes(
        surfaces["femur"], surfaces["tibia"], tuple(menisci.values()), _lateral(menisci), digest.hexdigest()
    )


def _role(name: str) -> str | None:
    text = name.lower()
    if "menisc" in text:
        side = next((word for word in ("medial", "lateral") if word in text), None)
        return None if side is None else f"{side} meniscus"
    return next((role for role in ("femur", "tibia") if role[:4] in text and "bone" not in text), None)


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError:
        raise SimulationError("meshes need trimesh and embreex: run make anatomy") from None
    return trimesh


def _read(path: Path, scale: float) -> Surface:
    trimesh = _trimesh()
    try:
        with open_file(path) as file:
            data = BytesIO(file.read(_MOST_BYTES))
        mesh = trimesh.load(data, file_type=path.suffix.lower()[1:], force="mesh", process=True)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except FileError:
        raise
    except Exception as error:  # the readers of three formats raise whatever they meet
        reason = " ".join(str(error).split())[:120]
        raise SimulationError(f"{path} cannot be read as a mesh: {reason}") from None
    if vertices.ndim != 2 or faces.ndim != 2 or len(faces) < _LEAST_FACES:
        raise SimulationError(f"{path} is empty: it holds fewer than {_LEAST_FACES} triangles")
    if not np.isfinite(vertices).all():
        raise SimulationError(f"{path} has vertices that are not finite")
    # STL has a vertex for every corner: one vertex for equal ones.
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = faces.T
    return Surface(scale * unique, faces[(a != b) & (b != c) & (c != a)])


def _check_size(femur: Surface, path: Path, unit: str) -> None:
    width = float(np.ptp(femur.vertices[:, 2]))
    if _WIDTHS[0] <= width <= _WIDTHS[1]:
        return
    for other, scale in UNITS.items():
        if other != unit and _WIDTHS[0] <= width / UNITS[unit] * scale <= _WIDTHS[1]:
            name = {"m": "metres", "mm": "millimetres"}[other]
            raise SimulationError(f"{path} is in {name} by its size: add --mesh-unit {other}")
    raise SimulationError(f"{path} is {1e3 * width:.3g} mm wide along z: no femur (40 to 120 mm)")


def _check_holes(surface: Surface, path: Path) -> None:
    """A surface is closed, or each piece has one border: more borders are holes."""
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    if (counts > 2).any():
        raise SimulationError(f"{path} is no surface: {(counts > 2).sum()} edges join three triangles")
    border = unique[counts == 1]
    pieces = _pieces(len(surface.vertices), edges)
    loops = _pieces(len(surface.vertices), border)
    owners = [pieces[loop] for loop in {int(loops[vertex]) for vertex in border.ravel()}]
    holes = len(owners) - len(set(owners))
    if holes:
        raise SimulationError(f"{path} has {holes} hole{'s' if holes > 1 else ''}: close them first")


def _pieces(count: int, edges: Faces) -> Faces:
    """For each vertex the lowest vertex of its connected piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    first = np.full(labels.max() + 1, count)
    np.minimum.at(first, labels, np.arange(count))
    return np.asarray(first[labels], dtype=np.int64)


def _check_places(surfaces: dict[str, Surface], found: dict[str, Path]) -> None:
    femur, tibia = surfaces["femur"], surfaces["tibia"]
    for axis, name in ((0, "x"), (2, "z")):
        low = max(float(s.vertices[:, axis].min()) for s in (femur, tibia))
        high = min(float(s.vertices[:, axis].max()) for s in (femur, tibia))
        if high - low < 0.015:
            raise SimulationError(
                f"{found['femur'].name} and {found['tibia'].name} do not overlap along {name}: two frames?"
            )
    if not femur.vertices[:, 1].mean() > tibia.vertices[:, 1].mean():
        raise SimulationError(f"{found['femur'].name} does not lie above the tibia: y must point up the leg")
    between = femur.vertices[:, 1].min() - tibia.vertices[:, 1].max()
    if between > 0.03:
        raise SimulationError(
            f"{found['femur'].name} and {found['tibia'].name} do not overlap: {1e3 * between:.0f} mm apart"
        )


def _check_sides(surfaces: dict[str, Surface], found: dict[str, Path]) -> None:
    for role, surface in surfaces.items():
        a, b, c = surface.corners.transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        if (np.unique(edges, axis=0, return_counts=True)[1] == 2).all():
            outward = float(np.einsum("ij,ij->", a, np.cross(b, c)))  # six times the volume
        elif role == "tibia":
            outward = float(normals[:, 1].sum())
        else:
            outward = float(((a + b + c) / 3.0 - surface.vertices.mean(axis=0)).ravel() @ normals.ravel())
        if not outward > 0.0:
            raise SimulationError(f"{found[role]} is inside out: its normals point into the tissue")


def _lateral(menisci: dict[str, Surface]) -> int:
    places = {role.split()[0]: surface.vertices[:, 2].mean() for role, surface in menisci.items()}
    if not places:
        return 1
    if len(places) == 2:
        return 1 if places["lateral"] > places["medial"] else -1
    ((side, place),) = places.items()
    return int(np.sign(place)) * (1 if side == "lateral" else -1) or 1


def samples(surface: Surface, spacing: float) -> Iterator[tuple[Array, Array]]:
    """Points (n, 3) on triangles at most ``spacing`` [m] apart, with normals (n, 3), by pieces."""
    corners = surface.corners
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    for count in np.unique(parts):
        chosen = np.flatnonzero(parts == count)
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        kept = i + j <= count
        u, v = i[kept] / count, j[kept] / count
        weights = np.stack([1.0 - u - v, u, v], axis=-1)
        points = np.einsum("kw,mwd->mkd", weights, corners[chosen])
        yield points.reshape(-1, 3), np.repeat(normals[chosen], len(weights), axis=0)


def sampled(surface: Surface, spacing: float) -> tuple[Array, Array]:
    """All points (n, 3) of `samples`, and their normals (n, 3)."""
    parts = list(samples(surface, spacing))
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])
