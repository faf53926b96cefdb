"""What a simulated recording gave, beside its truth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_replay.bag import BagReader
from knee_gap_simulation.recording import LENS_POSE_TRUE
from knee_gap_simulation.rigid import from_parts
from knee_gap_simulation.truth import SceneTruth, scene_from_metadata
from knee_gap_uncertainty.gap_estimate import GapStatus
from knee_gap_uncertainty.messages import stamp_ns

Floats = npt.NDArray[np.float64]
EDGES = "/knee_gap/gap_edges"
GAP = "/knee_gap/gap"


class Comparison(NamedTuple):
    """Every estimate beside the truth; each array has one entry an estimate; metres, NaN if unknown.

    `time` [s] counts from the first estimate; `truth` is the distance of the two surface points that the
    track's first image showed at its pixels.
    """

    time: Floats
    valid: npt.NDArray[np.bool_]
    gap: Floats
    gap_min: Floats
    gap_max: Floats
    confidence_min: Floats
    confidence_max: Floats
    snr: Floats
    baseline: Floats
    truth: Floats

    @property
    def median_error(self) -> float:
        """Median of |gap - truth| over the valid estimates [m]."""
        errors = np.abs(self.gap - self.truth)[self.valid]
        return float(np.median(errors)) if errors.size else float("nan")

    @property
    def inside(self) -> float:
        """Share of the valid estimates whose [gap_min, gap_max] holds the truth [-]."""
        held = (self.gap_min <= self.truth) & (self.truth <= self.gap_max)
        return float(np.mean(held[self.valid])) if self.valid.any() else float("nan")

    def summary(self) -> str:
        """One line: how many, how many valid, how far from the truth."""
        return (
            f"{len(self.time)} estimates, {int(self.valid.sum())} valid, median |gap - truth| "
            f"{1e3 * self.median_error:.3f} mm, truth inside [min, max] {100 * self.inside:.1f} %"
        )


def compare(recording: Path, output: Path) -> Comparison:
    """Read the estimates of `output` beside the truth that the simulated bag `recording` carries.

    Raises BagError for a bag that cannot be read and SimulationError for one that is not simulated.
    """
    truths = _truth_by_track(recording, output)
    rows = []
    with BagReader(output) as bag:
        for entry in bag.messages([GAP]):
            estimate = bag.deserialize(entry)
            rows.append(
                (
                    stamp_ns(estimate.header) * 1e-9,
                    estimate.status == GapStatus.VALID,
                    estimate.gap,
                    estimate.gap_min,
                    estimate.gap_max,
                    estimate.confidence_min,
                    estimate.confidence_max,
                    estimate.snr,
                    estimate.baseline,
                    truths.get(int(estimate.track_id), np.nan),
                )
            )
    columns = np.array(rows, dtype=np.float64).reshape(-1, 10).T
    time = columns[0] - columns[0].min(initial=np.inf) if rows else columns[0]
    return Comparison(time, columns[1].astype(bool), *columns[2:])


def _truth_by_track(recording: Path, output: Path) -> dict[int, float]:
    """True distance [m] of the two surface points that each track chose, by track_id."""
    with BagReader(recording) as bag:
        scene = scene_from_metadata(bag.metadata)
        poses = {}
        for entry in bag.messages([LENS_POSE_TRUE]):
            pose = bag.deserialize(entry)
            poses[stamp_ns(pose.header)] = pose.pose
    truths: dict[int, float] = {}
    with BagReader(output) as bag:
        for entry in bag.messages([EDGES]):
            edges = bag.deserialize(entry)
            stamp = stamp_ns(edges.header)
            if edges.track_id and edges.track_id not in truths and stamp in poses:
                truths[edges.track_id] = true_gap(scene, poses[stamp], edges)
    return truths


def true_gap(scene: SceneTruth, pose: object, edges: object) -> float:
    """Distance [m] of the surface points behind the two pixels of `edges`, seen from the true lens `pose`."""
    p, q = pose.position, pose.orientation  # type: ignore[attr-defined]
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T_world_lens = from_parts(rotation, [p.x, p.y, p.z])
    pixels = np.array([edges.pixel_0, edges.pixel_1])  # type: ignore[attr-defined]
    points = scene.surface_points(T_world_lens, pixels)
    return float(np.linalg.norm(points[1] - points[0]))
