"""Pose of the femur over the tibia: flexion, then an opening of one compartment as a hand opens it.

Axes of this module are those of the scene: x along the gap, y from femur to tibia, z to the back of the knee.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, rigid
from knee_gap_simulation.anatomy.meshes import KneeMeshes, Surface, sampled
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.scene import NEAREST_WITHIN

# From x forward, y up, z to the right.
AXES = rigid(np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]), np.zeros(3))
MOST_FLEXION = np.radians(130.0)
# A hand tilts the femur by at most this much against the tibia [rad].
MOST_TILT = np.radians(12.0)
# Contact of cartilage: the surfaces come this close [m]; a closed joint overlaps.
_CONTACT, _CLOSED = 0.1e-3, -0.3e-3
_COARSE, _FINE = 0.7e-3, 0.2e-3  # spacing of samples [m]
_HALF_WIDTH = 0.012  # of a condyle [m]
_MOST_POINTS = 1200  # of a condyle, for its opening


class Compartment(StrEnum):
    """Side of the joint whose gap is asked for."""

    MEDIAL = "medial"
    LATERAL = "lateral"


class PosedKnee(NamedTuple):
    """The surfaces in the scene, whose origin is the middle of the narrowest place of the gap.

    ``tilt`` [rad] is the varus or valgus that opens the gap. ``nearest`` is the smallest distance [m] within
    ``NEAREST_WITHIN`` of the middle, of a point of the femur and one of the tissue below.
    """

    femur: Surface
    tibia: Surface
    menisci: tuple[Surface, ...]
    tilt: float
    nearest: tuple[float, Array, Array]


class _Side(NamedTuple):
    """One compartment: its middle along x, and the tissue below, (n, 3) points and normals."""

    middle: float
    tree: cKDTree
    normals: Array


def posed(meshes: KneeMeshes, compartment: Compartment, flexion: float, gap: float | None) -> PosedKnee:
    """The knee flexed, with a gap [m] in one compartment; None closes it. Raises SimulationError."""
    if not 0.0 <= flexion <= MOST_FLEXION:
        raise SimulationError(
            f"the flexion must lie in [0, {np.degrees(MOST_FLEXION):.0f}] degrees, "
            f"not {np.degrees(flexion):g}"
        )
    femur, tibia = meshes.femur.moved(AXES), meshes.tibia.moved(AXES)
    menisci = tuple(meniscus.moved(AXES) for meniscus in meshes.menisci)
    below = Surface.joined([tibia, *menisci])
    side = meshes.lateral * (1 if compartment is Compartment.MEDIAL else -1)
    chosen, other = _side(below, side), _side(below, -side)
    femur = femur.moved(
        _flexed(femur, (chosen.middle, other.middle), float(below.vertices[:, 2].mean()), flexion)
    )
    points = sampled(femur, _COARSE)[0]
    T, tilt = _opened(points, chosen, other, gap, str(compartment))
    femur = femur.moved(T)
    wanted = _CLOSED if gap is None else gap
    tissue = _Below(below, chosen.middle)
    for _ in range(8):
        nearest = tissue.nearest(femur)
        if abs(nearest[0] - wanted) < 1e-6:
            break
        # Along y, in the proportion in which the pair comes apart.
        across = (nearest[2] - nearest[1])[1] / max(abs(nearest[0]), 1e-9)
        share = float(np.clip(abs(across), 0.4, 1.0))
        lift = (wanted - nearest[0]) / share
        femur = femur.moved(rigid(np.eye(3), np.array([0.0, -lift, 0.0])))
    if abs(nearest[0] - wanted) > 0.05e-3:
        raise SimulationError(
            f"the {compartment} compartment cannot be set to {1e3 * wanted:g} mm: "
            f"{1e3 * nearest[0]:.2f} mm at best"
        )
    origin = 0.5 * (nearest[1] + nearest[2])
    origin[0] = chosen.middle
    shift = rigid(np.eye(3), -origin)
    pair = nearest[0], nearest[1] - origin, nearest[2] - origin
    return PosedKnee(
        femur.moved(shift), tibia.moved(shift), tuple(m.moved(shift) for m in menisci), tilt, pair
    )


def _side(below: Surface, side: int) -> _Side:
    points, normals = sampled(below, _COARSE)
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max())
    kept = side * (points[:, 0] - middle) > 0.003
    reach = float(np.abs(points[kept, 0] - middle).max())
    return _Side(float(middle + side * 0.55 * reach), cKDTree(points[kept]), normals[kept])


def _flexed(femur: Surface, middles: tuple[float, float], centre: float, flexion: float) -> Array:
    """Rotation (4, 4) by the flexion about the axis of the circles of the posterior condyles."""
    v = femur.vertices
    centres = []
    for middle in middles:
        near = v[(np.abs(v[:, 0] - middle) < 0.5 * _HALF_WIDTH) & (v[:, 2] > centre)]
        if len(near) < 10:
            raise SimulationError("the femur has no condyle above one side of the tibia")
        # y^2 + z^2 = 2 b y + 2 c z + d
        y, z = near[:, 1], near[:, 2]
        rows = np.stack([2.0 * y, 2.0 * z, np.ones(len(near))], axis=-1)
        b, c, _ = np.linalg.lstsq(rows, y * y + z * z, rcond=None)[0]
        centres.append(np.array([middle, b, c]))
    axis = centres[1] - centres[0]
    axis *= np.sign(axis[0]) / np.linalg.norm(axis)
    turn = from_rotation_vectors(-flexion * axis, np.zeros(3))[:3, :3]
    pivot = 0.5 * (centres[0] + centres[1])
    return rigid(turn, pivot - turn @ pivot)


def _opened(points: Array, chosen: _Side, other: _Side, gap: float | None, name: str) -> tuple[Array, float]:
    """Pose (4, 4) that opens the chosen side while the other stays in contact, and its tilt [rad]."""
    near = [_lowest(points, side) for side in (chosen, other)]
    away = np.sign(other.middle - chosen.middle)
    lift = 0.0

    def placed(tilt: float) -> Array:
        nonlocal lift
        turn = from_rotation_vectors([0.0, 0.0, tilt * away], np.zeros(3))[:3, :3]
        pivot = np.array([other.middle, 0.0, 0.0])
        base = pivot - turn @ pivot
        for _ in range(12):
            T = rigid(turn, base - np.array([0.0, lift, 0.0]))
            least = _least(near[1], T, other)
            if tilt == 0.0:
                least = min(least, _least(near[0], T, chosen))
            lift += _CONTACT - least
            if abs(_CONTACT - least) < 5e-6:
                break
        return rigid(turn, base - np.array([0.0, lift, 0.0]))

    start = placed(0.0)
    low, narrow = 0.0, _least(near[0], start, chosen)
    if gap is None or narrow >= gap:
        return start, 0.0
    high, widest = float(MOST_TILT), _least(near[0], placed(MOST_TILT), chosen)
    if widest < gap:
        raise SimulationError(
            f"the {name} compartment cannot be opened to {1e3 * gap:g} mm: "
            f"{1e3 * widest:.1f} mm at {np.degrees(MOST_TILT):.0f} degrees of "
            f"{'valgus' if name == 'medial' else 'varus'}"
        )
    T, tilt = start, 0.0
    for _ in range(8):
        tilt = low + (high - low) * float(np.clip((gap - narrow) / (widest - narrow), 0.05, 0.95))
        T = placed(tilt)
        reached = _least(near[0], T, chosen)
        if abs(reached - gap) < 20e-6:
            break
        low, narrow, high, widest = (
            (tilt, reached, high, widest) if reached < gap else (low, narrow, tilt, reached)
        )
    return T, tilt


def _lowest(points: Array, side: _Side) -> Array:
    """The points (n, 3) of the condyle that can come near the tissue below."""
    near = points[np.abs(points[:, 0] - side.middle) < _HALF_WIDTH]
    if len(near) < 10:
        raise SimulationError("the femur has no condyle above one side of the tibia")
    far = side.tree.query(near)[0]
    return np.asarray(near[np.argsort(far)[:_MOST_POINTS]])


def _least(points: Array, T: Array, side: _Side) -> float:
    """Smallest distance [m] of points (n, 3), moved by T, from the tissue below; negative inside it."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    far, index = side.tree.query(moved)
    away = moved - side.tree.data[index]
    along = np.einsum("ij,ij->i", away, side.normals[index])
    inside = along < -0.7 * far
    return float(np.where(inside, -far, far).min())


class _Below:
    """The tissue below, near the middle of one compartment, sampled finely."""

    def __init__(self, below: Surface, middle: float) -> None:
        self._middle = middle
        self._points, self._normals = sampled(self._cut(below), _FINE)
        self._tree = cKDTree(self._points)

    def nearest(self, femur: Surface) -> tuple[float, Array, Array]:
        """The nearest pair of points near the middle: signed distance, the femur's, the one below."""
        cut = self._cut(femur)
        corners = cut.corners
        centres, size = corners.mean(axis=1), float(np.ptp(corners, axis=1).max())
        far = self._tree.query(centres, distance_upper_bound=0.014)[0]
        far[np.abs(centres[:, 0] - self._middle) > NEAREST_WITHIN + 0.5 * size] = np.inf
        if not np.isfinite(far).any():
            raise SimulationError("the femur lies nowhere above the tissue below it")
        upper = sampled(Surface(cut.vertices, cut.faces[far < far.min() + 0.6 * size]), _FINE)[0]
        upper = upper[np.abs(upper[:, 0] - self._middle) <= NEAREST_WITHIN]
        far, index = self._tree.query(upper, distance_upper_bound=far.min() + 2.0 * size)
        upper, index, far = (values[np.isfinite(far)] for values in (upper, index, far))
        along = np.einsum("ij,ij->i", upper - self._points[index], self._normals[index])
        signed = np.where(along < -0.7 * far, -far, far)
        best = int(np.argmin(signed))
        return float(signed[best]), upper[best].copy(), self._points[index[best]].copy()

    def _cut(self, surface: Surface) -> Surface:
        x, reach = surface.vertices[:, 0][surface.faces], NEAREST_WITHIN + 0.003
        kept = (x.max(axis=1) > self._middle - reach) & (x.min(axis=1) < self._middle + reach)
        return Surface(surface.vertices, surface.faces[kept])
