"""Simulated observations of a knee that opens: bearings and poses drawn from its truth."""

from dataclasses import dataclass, replace

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import LENS_FRAME, EdgeStatus, GapEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.knee_views import ViewDrawer, ViewErrors, edges_seen, points_beside
from knee_gap_simulation.recordings.section_truth import true_instrument_gap

# Longest part of the hand's motion in which the scope is kept clear of the tissue [s].
_CLEAR_FOR = 8.0


@dataclass(frozen=True, eq=False)
class _Section:
    """The section of a track: its direction in the scene, and its points (2, 3) at an opening [m]."""

    across: Array
    points: Array
    opening: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """What an image showed: pose of the lens (4, 4), true edges (2, 3), opening [m]."""

    T_scene_lens: Array
    edges: Array
    opening: float


class OpeningKnee:
    """A knee whose condyle is moved away from the meniscus, seen by a scope in a moving hand.

    Lengths [m], times [s]. The opening is the nearest distance between the two at the start, plus how far the
    condyle has moved since. Raises SimulationError if the scope does not fit into the joint.
    """

    def __init__(self, level: int, seed: int, opening: float, errors: ViewErrors) -> None:
        self._simulator = KneeSimulator(level, seed, "along", gap=opening, duration_s=_CLEAR_FOR, fps=10.0)
        self._drawer = ViewDrawer(np.random.default_rng([seed, 0x434C]), errors)
        self._start = opening
        self._ridge = self._simulator.scene.ridge(0.0)[0]
        self._section: _Section | None = None
        self._track_id = 0
        self._seen: dict[int, _Seen] = {}

    def measure_again(self) -> None:
        """End the track: the next image chooses its points again."""
        self._section = None

    def observe(self, stamp_ns: int, time: float, opening: float) -> tuple[GapEdges, LensPose]:
        """Edges and lens pose of an image at a time, with the joint opened so far."""
        T_scene_lens = self._simulator.pose(time)
        pose = self._drawer.lens_pose(stamp_ns, T_scene_lens)
        edges = self._edges(T_scene_lens, opening)
        section = self._section
        if section is None or not np.isfinite(edges).all():
            # The points are out of view, or were never found: a new track begins with the next image.
            self._section = None
            return GapEdges.without_points(stamp_ns, LENS_FRAME, EdgeStatus.NO_GAP), pose
        self._seen[stamp_ns] = _Seen(T_scene_lens, edges, opening)
        # The upper point is on the condyle and moves with it.
        points = section.points - [[0.0, opening - section.opening, 0.0], [0.0, 0.0, 0.0]]
        return self._drawer.observation(stamp_ns, T_scene_lens, points, edges, self._track_id), pose

    def true_gap(self, stamp_ns: int | None = None) -> float:
        """The instrument gap at the section of an image, by default of the latest; NaN if none was seen."""
        stamp_ns = max(self._seen, default=0) if stamp_ns is None else stamp_ns
        seen = self._seen.get(stamp_ns)
        if seen is None:
            return float("nan")
        return true_instrument_gap(self._scene(seen.opening), seen.T_scene_lens, seen.edges).diameter

    def _edges(self, T_scene_lens: Array, opening: float) -> Array:
        """True edges of the track's section, which is chosen if there is none; NaN if it cannot be."""
        scene, lens = self._scene(opening), self._simulator.lens
        middle = self._ridge - (0.0, 0.5 * opening, 0.0)
        if self._section is not None:
            return edges_seen(scene, lens, T_scene_lens, middle, self._section.across)
        edges = edges_seen(scene, lens, T_scene_lens, middle)
        if np.isfinite(edges).all():
            try:
                points = points_beside(scene, T_scene_lens, edges)
            except SimulationError:
                return np.full((2, 3), np.nan)
            across = T_scene_lens[:3, :3] @ (edges[1] - edges[0])
            self._section = _Section(across, points, opening)
            self._track_id += 1
        return edges

    def _scene(self, opening: float) -> KneeScene:
        scene = self._simulator.scene
        assert isinstance(scene, KneeScene)  # a knee of meshes is not opened by a controller
        x, y, z = scene.condyle_centre
        return replace(scene, condyle_centre=(x, y - (opening - self._start), z))
