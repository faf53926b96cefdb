"""Simulated observations of a knee without pictures: edges and lens poses with errors.

The bearings of two true points of the anatomy and of the true edges are wrong by errors drawn from their
stated covariances, and so is the pose of the lens.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeKind, EdgeState, GapEdges, SectionEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.recordings.section_truth import Scene, edges_at_section
from knee_gap_simulation.scope.lens import Lens

# How far beside the edges the two points lie.
INSET = np.radians(2.0)
# Codes of knee_gap_msgs/GapEdges: the upper edge is the contour of the condyle, the lower one a rim.
# A direction in the scene is taken to the image over this length [m].
_STEP = 1e-4


@dataclass(frozen=True)
class ViewErrors:
    """Standard deviations: of directions [rad], and of a lens pose, along each axis [m] and [rad].

    The drawn errors are `excess` times as large as those stated: 1 is an honest sensor.
    """

    point: float = float(np.radians(0.05))
    edge: float = float(np.radians(0.15))
    position: float = 0.0367e-3 / float(np.sqrt(3.0))
    rotation: float = float(np.radians(0.004)) / float(np.sqrt(3.0))
    excess: float = 1.0


def edges_seen(
    scene: Scene, lens: Lens, T_scene_lens: Array, middle: Array, across: Array | None = None
) -> Array:
    """True bearings (2, 3) of the edges through a point (3,) in the opening; NaN if they are not seen.

    `across` (3,) is the direction of the section in the scene; by default that of the narrowest opening,
    which takes twenty times as long to find.
    """
    pixel = _pixel(lens, T_scene_lens, middle)
    direction = None
    if across is not None:
        direction = _pixel(lens, T_scene_lens, middle + _STEP * across / np.linalg.norm(across)) - pixel
    if not np.isfinite(pixel).all() or (direction is not None and not np.isfinite(direction).all()):
        return np.full((2, 3), np.nan)
    return edges_at_section(scene, lens, T_scene_lens, pixel, direction)


def points_beside(scene: Scene, T_scene_lens: Array, edges: Array) -> Array:
    """Surface points (2, 3) of the scene, `INSET` beside two edges (2, 3) of the lens.

    Raises SimulationError if there is not tissue.
    """
    view, across = edges.sum(axis=0), edges[1] - edges[0]
    view, across = view / np.linalg.norm(view), across / np.linalg.norm(across)
    half = 0.5 * float(np.arccos(np.clip(edges[0] @ edges[1], -1.0, 1.0)))
    angles = np.array([-half - INSET, half + INSET])[:, None]
    points = scene.surface_points(T_scene_lens, np.cos(angles) * view + np.sin(angles) * across)
    if not np.isfinite(points).all():
        raise SimulationError("the section has no tissue beside its edges")
    return np.asarray(points)


class ViewDrawer:
    """Draws what the nodes would be given of one image; the same seed gives the same errors."""

    def __init__(self, rng: np.random.Generator, errors: ViewErrors | None = None) -> None:
        self._rng = rng
        self.errors = errors or ViewErrors()

    def observation(
        self, stamp_ns: int, T_scene_lens: Array, points: Array, edges: Array, track_id: int = 1
    ) -> GapEdges:
        """Two points (2, 3) of the scene and edges (2, 3) of the lens, as segmentation_node reports them."""
        errors = self.errors
        seen = (points - T_scene_lens[:3, 3]) @ T_scene_lens[:3, :3]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        bearings = self._wrong(seen, errors.excess * errors.point)
        # The edge is wrong across the opening, which is where it is looked for.
        axis = np.cross(edges[0], edges[1])
        axis /= np.linalg.norm(axis)
        turned = [
            Rotation.from_rotvec(errors.excess * errors.edge * self._rng.standard_normal() * axis).apply(edge)
            for edge in edges
        ]
        outer = bearings[..., :, None] * bearings[..., None, :]
        covariances = errors.point**2 * (np.eye(3) - outer)
        return replace(
            GapEdges.of_points(stamp_ns, track_id, bearings, covariances, angular_error=3.0 * errors.point),
            kinds=(EdgeKind.CONTOUR, EdgeKind.RIM),
            section=SectionEdges(
                (EdgeState.SEEN, EdgeState.SEEN), np.array(turned), np.full(2, errors.edge), 3.0 * errors.edge
            ),
        )

    def lens_pose(self, stamp_ns: int, T_scene_lens: Array) -> LensPose:
        """A pose of the lens, as tracking_node reports it; the scene stands for the world."""
        errors = self.errors
        turn = Rotation.from_rotvec(errors.excess * errors.rotation * self._rng.standard_normal(3))
        rotation = Rotation.from_matrix(T_scene_lens[:3, :3]) * turn
        shift = errors.excess * errors.position * self._rng.standard_normal(3)
        return LensPose(
            stamp_ns=stamp_ns,
            frame_id="world",
            position=T_scene_lens[:3, 3] + shift,
            quaternion_xyzw=rotation.as_quat(),
            covariance=np.diag([errors.position**2] * 3 + [errors.rotation**2] * 3),
        )

    def _wrong(self, directions: Array, deviation: float) -> Array:
        moved = directions + deviation * self._rng.standard_normal(directions.shape)
        return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _pixel(lens: Lens, T_scene_lens: Array, point: npt.ArrayLike) -> Array:
    return lens.pixels(T_scene_lens[:3, :3].T @ (np.asarray(point) - T_scene_lens[:3, 3]))
