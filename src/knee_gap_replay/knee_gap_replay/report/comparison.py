"""Comparison of the estimates of a simulated recording with its ground truth."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_core.values.rigid_transforms import rigid
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_simulation.recordings.recording import LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import SceneTruth, scene_from_metadata

Floats = npt.NDArray[np.float64]
EDGES = "/knee_gap/gap_edges"
GAP = "/knee_gap/gap"

_EDGE_SEEN = 1  # knee_gap_msgs/GapEdges


@dataclass(frozen=True)
class Comparison:
    """Every estimate and its ground truth; arrays with one entry per estimate, in metres, NaN if unknown.

    `time` [s] counts from the first estimate. `truth` is the instrument gap of the section whose edges were
    found in the estimate's image. If not both were found, it is that of the section through the middle
    between its tracked points. `point_truth` is the distance between the two surface points behind the
    track's pixels in its first image. The other fields are those of the same name in
    knee_gap_msgs/GapEstimate.
    """

    time: Floats
    valid: npt.NDArray[np.bool_]
    truth: Floats
    point_truth: Floats
    gap: Floats
    gap_min: Floats
    gap_max: Floats
    confidence_min: Floats
    confidence_max: Floats
    point_distance: Floats
    point_distance_min: Floats
    point_distance_max: Floats
    point_distance_confidence_min: Floats
    point_distance_confidence_max: Floats
    snr: Floats
    baseline: Floats

    @property
    def median_error(self) -> float:
        """Median of |gap - truth| over the valid estimates [m]."""
        return self._median(np.abs(self.gap - self.truth))

    @property
    def median_point_error(self) -> float:
        """Median of |point_distance - point_truth| over the valid estimates [m]."""
        return self._median(np.abs(self.point_distance - self.point_truth))

    @property
    def median_width(self) -> float:
        """Median of gap_max - gap_min over the valid estimates [m]."""
        return self._median(self.gap_max - self.gap_min)

    @property
    def inside(self) -> float:
        """Fraction of the valid estimates whose [gap_min, gap_max] contains the truth [-]."""
        return self._share((self.gap_min <= self.truth) & (self.truth <= self.gap_max))

    @property
    def above_minimum(self) -> float:
        """Fraction of the valid estimates whose gap_min is not above the truth [-]."""
        return self._share(self.gap_min <= self.truth)

    @property
    def below_maximum(self) -> float:
        """Fraction of the valid estimates whose gap_max is not below the truth [-]."""
        return self._share(self.truth <= self.gap_max)

    @property
    def in_interval(self) -> float:
        """Fraction of the valid estimates whose confidence interval contains the truth [-]."""
        return self._share((self.confidence_min <= self.truth) & (self.truth <= self.confidence_max))

    @property
    def points_inside(self) -> float:
        """Fraction of the valid estimates whose bounds of the points' distance contain its truth [-]."""
        low, high = self.point_distance_min, self.point_distance_max
        return self._share((low <= self.point_truth) & (self.point_truth <= high))

    def summary(self) -> str:
        """One line: number of estimates, number of valid ones, errors and coverage."""
        return (
            f"{len(self.time)} estimates, {int(self.valid.sum())} valid, median |gap - truth| "
            f"{1e3 * self.median_error:.3f} mm, truth inside [min, max] {100 * self.inside:.1f} % "
            f"(min holds {100 * self.above_minimum:.1f} %, width {1e3 * self.median_width:.2f} mm); "
            f"points {1e3 * self.median_point_error:.3f} mm, in bounds {100 * self.points_inside:.1f} %"
        )

    def _median(self, values: Floats) -> float:
        chosen = values[self.valid]
        return float(np.median(chosen)) if chosen.size else float("nan")

    def _share(self, held: npt.NDArray[np.bool_]) -> float:
        # An unknown truth counts as not contained.
        return float(np.mean(held[self.valid])) if self.valid.any() else float("nan")


# Fields that are not copied from the estimate under their own name.
_FOUND = ("time", "valid", "truth", "point_truth")
_READ = tuple(entry.name for entry in fields(Comparison) if entry.name not in _FOUND)


def compare(recording: Path, output: Path) -> Comparison:
    """Return the estimates of `output` with the ground truth in the simulated bag `recording`.

    Raises BagError for a bag that cannot be read and SimulationError for one that is not simulated.
    """
    truths = Truths(recording, output)
    columns: dict[str, list[float]] = {entry.name: [] for entry in fields(Comparison) if entry.name != "time"}
    stamps: list[int] = []
    with BagReader(output) as bag:
        for entry in bag.messages([GAP]):
            estimate = bag.deserialize(entry)
            stamp = stamp_ns(estimate.header)
            stamps.append(stamp)
            columns["valid"].append(estimate.status == GapStatus.VALID)
            columns["truth"].append(truths.instrument_gap(stamp))
            columns["point_truth"].append(truths.point_distance(int(estimate.track_id)))
            for name in _READ:
                columns[name].append(getattr(estimate, name))
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    valid = arrays.pop("valid").astype(bool)
    # Differences of whole nanoseconds: seconds since 1970 as floats resolve only 0.2 us.
    first = min(stamps, default=0)
    time = np.array([1e-9 * (stamp - first) for stamp in stamps])
    return Comparison(time=time, valid=valid, **arrays)


class Truths:
    """Ground truth of a recording at the stamps of its images, for the points and sections of an output.

    Raises BagError for a bag that cannot be read and SimulationError for a recording that is not simulated.
    """

    def __init__(self, recording: Path, output: Path, edges_topic: str = EDGES) -> None:
        with BagReader(recording) as bag:
            self._scene = scene_from_metadata(bag.metadata)
            self._poses: dict[int, Array] = {}
            for entry in bag.messages([LENS_POSE_TRUE]):
                pose = bag.deserialize(entry)
                self._poses[stamp_ns(pose.header)] = _matrix(pose.pose)
        self._edges: dict[int, Any] = {}
        self._points: dict[int, float] = {}
        self._gaps: dict[int, float] = {}
        with BagReader(output) as bag:
            for entry in bag.messages([edges_topic]):
                edges = bag.deserialize(entry)
                stamp = stamp_ns(edges.header)
                if not edges.track_id or stamp not in self._poses:
                    continue
                self._edges[stamp] = edges
                if edges.track_id not in self._points:
                    self._points[int(edges.track_id)] = true_point_distance(
                        self._scene, self._poses[stamp], edges
                    )

    def point_distance(self, track_id: int) -> float:
        """True distance [m] of the two surface points that a track chose; NaN if unknown."""
        return self._points.get(track_id, float("nan"))

    def instrument_gap(self, stamp: int) -> float:
        """True instrument gap [m] at the section of the image of a stamp [ns]; NaN if unknown."""
        if stamp not in self._gaps:
            edges = self._edges.get(stamp)
            self._gaps[stamp] = (
                float("nan") if edges is None else true_gap(self._scene, self._poses[stamp], edges)
            )
        return self._gaps[stamp]


def true_gap(scene: SceneTruth, T_world_lens: Array, edges: Any) -> float:
    """True instrument gap [m] at the section of a GapEdges message, seen from a true lens pose (4, 4).

    If it does not have both edges, the section leads through the middle between its tracked points. NaN if
    that is not in the opening.
    """
    bearings = np.array([[edge.x, edge.y, edge.z] for edge in (edges.edge_0, edges.edge_1)])
    if not edges.edge_state_0 == edges.edge_state_1 == _EDGE_SEEN:
        bearings[:] = np.nan
    return scene.reported_gap(T_world_lens, bearings, np.array([edges.pixel_0, edges.pixel_1]))


def true_point_distance(scene: SceneTruth, T_world_lens: Array, edges: Any) -> float:
    """Distance [m] of the surface points behind the pixels of a GapEdges message, from a true lens pose."""
    points = scene.surface_points(T_world_lens, np.array([edges.pixel_0, edges.pixel_1]))
    return float(np.linalg.norm(points[1] - points[0]))


def _matrix(pose: Any) -> Array:
    """A geometry_msgs/Pose as (4, 4)."""
    p, q = pose.position, pose.orientation
    return rigid(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [p.x, p.y, p.z])
