"""The edges of the gap on simulated knees whose truth is known, level by level, on seeds of your choice.

A track is scored from its first image on: the surface points behind its first two pixels are its truth.
Errors are given along and across the edge, in degrees, as the median over tracks of their root mean square;
NEES is the squared error in units of its own covariance, against its expectation; held is the share of
images with a valid track while both are to be seen. The gap is what the estimator makes of it with the
tracked poses: its error against the true instrument gap at the section that the image's edges give, and the
shares of valid estimates whose bounds and interval hold that. The same follows for the points' distance.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from kept_frames import frames_of
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from knee_gap_core.bag.message_types import blank
from knee_gap_core.conversions.edge_messages import edges_from_message, fill_gap_edges
from knee_gap_core.conversions.pose_messages import fill_lens_pose, lens_pose_from_message
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeStatus, GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_perception.camera.camera import bearing_jacobian
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import KneeSimulator, SimulatorFrame
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

EXACT = EstimatorParameters(**EXACT_SCOPE)


# Errors of the tracked lens: the paper's RMS lengths, per axis, and the lever from the body to the lens.
POSITION_ERROR = float(np.hypot(0.0367e-3, 0.2 * np.radians(0.004)) / np.sqrt(3))
ROTATION_ERROR = float(np.radians(0.004) / np.sqrt(3))


class Judged(NamedTuple):
    """One number with its bounds and its interval, beside its truth [m]."""

    value: float
    minimum: float
    maximum: float
    low: float
    high: float
    truth: float


def judged_line(judged: Sequence[Judged]) -> str:
    """How many, their errors, and the shares whose bounds and interval hold the truth."""
    if not judged:
        return "valid 0"
    value, minimum, maximum, low, high, truth = np.array(judged).T
    return (
        f"valid {len(judged)}  error {1e3 * np.median(np.abs(value - truth)):.3f} mm  "
        f"bias {1e3 * np.median(value - truth):+.3f} mm  "
        f"min <= truth {100 * np.mean(minimum <= truth):.1f} %  "
        f"truth <= max {100 * np.mean(truth <= maximum):.1f} %, "
        f"{1e3 * np.median(maximum - minimum):.2f} mm wide  "
        f"in the interval {100 * np.mean((low <= truth) & (truth <= high)):.1f} %, "
        f"{1e3 * np.median(high - low):.2f} mm wide"
    )


@dataclass
class Scores:
    """What the images of one scope, or of many, add up to.

    `rms` holds one track's root mean square along and across the edge and over all [rad]; `gaps` the valid
    estimates beside the true instrument gap, `distances` the same of the distance of the points.
    """

    along: list[float] = field(default_factory=list)
    across: list[float] = field(default_factory=list)
    rms: list[tuple[float, float, float]] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    covered: list[bool] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    dice: list[float] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    gaps: list[Judged] = field(default_factory=list)
    distances: list[Judged] = field(default_factory=list)
    tracks: int = 0

    def add(self, other: "Scores") -> None:
        """Take in the images of another scope."""
        for name in (
            "along",
            "across",
            "rms",
            "nees",
            "covered",
            "bound",
            "dice",
            "held",
            "gaps",
            "distances",
        ):
            getattr(self, name).extend(getattr(other, name))
        self.tracks += other.tracks

    def finish(self) -> "Scores":
        """Sum up the root mean squares, after the last image."""
        if self.along:
            along, across = float(np.mean(np.square(self.along))), float(np.mean(np.square(self.across)))
            self.rms = [(along**0.5, across**0.5, (along + across) ** 0.5)]
        return self

    def line(self) -> str:
        """All of it in one line."""

        def mean(values: Sequence[float]) -> float:
            return float(np.mean(values)) if values else float("nan")

        def median(values: Sequence[float]) -> float:
            return float(np.median(values)) if values else float("nan")

        along, across, both = (np.degrees(median([track[k] for track in self.rms])) for k in range(3))
        return (
            f"Dice {mean(self.dice):.3f}  rms {both:.2f} deg (along {along:.2f}, across {across:.2f})  "
            f"bound {np.degrees(median(self.bound)):.2f} deg holds {100 * mean(self.covered):.1f} %  "
            f"NEES {mean(self.nees):.2f}  held {100 * mean(self.held):.0f} %  tracks {self.tracks}  |  "
            f"gap {judged_line(self.gaps)}  |  points {judged_line(self.distances)}"
        )


class GapCheck:
    """The estimator behind the edges, with the true gap at each image and the points' true distance."""

    def __init__(self, truth: SceneTruth) -> None:
        self._estimator, self._scene = GapEstimator(EXACT), truth
        self._truth: dict[int, float] = {}
        self._looked_at: dict[int, tuple[Array, GapEdges]] = {}

    def begin(self, track_id: int, points: Array) -> None:
        """Note the true points (2, 3) [m] of a track."""
        self._truth[track_id] = float(np.linalg.norm(points[1] - points[0]))

    def add(self, frame: SimulatorFrame, pose: LensPose, edges: GapEdges, scores: Scores) -> None:
        """Hand an image's edges and pose to the estimator, as messages, and score what comes out."""
        self._looked_at[edges.stamp_ns] = frame.T_world_lens, edges
        posed = fill_lens_pose(blank("geometry_msgs/msg/PoseWithCovarianceStamped"), pose)
        seen = fill_gap_edges(
            blank("knee_gap_msgs/msg/GapEdges"), edges, lambda: blank("knee_gap_msgs/msg/GapSection")
        )
        now = edges.stamp_ns
        estimates = self._estimator.add_pose(lens_pose_from_message(posed), now)
        estimates += self._estimator.add_edges(edges_from_message(seen), now)
        for estimate in estimates:
            if estimate.status is GapStatus.VALID:
                self._judge(estimate, scores)

    def _judge(self, estimate: GapEstimate, scores: Scores) -> None:
        """Add one valid estimate; a truth that is not known counts as not held."""
        T_world_lens, edges = self._looked_at[estimate.stamp_ns]
        seen = edges.section.bearings if edges.section.seen else np.full((2, 3), np.nan)
        scores.gaps.append(
            Judged(
                estimate.gap,
                estimate.gap_min,
                estimate.gap_max,
                estimate.confidence_min,
                estimate.confidence_max,
                self._scene.reported_gap(T_world_lens, seen, edges.pixels),
            )
        )
        scores.distances.append(
            Judged(
                estimate.point_distance,
                estimate.point_distance_min,
                estimate.point_distance_max,
                estimate.point_distance_confidence_min,
                estimate.point_distance_confidence_max,
                self._truth.get(estimate.track_id, np.nan),
            )
        )


def lens_pose(frame: SimulatorFrame) -> LensPose:
    """The tracked pose of the lens, as tracking_node would publish it."""
    T = frame.T_world_lens_tracked
    covariance = np.diag([POSITION_ERROR**2] * 3 + [ROTATION_ERROR**2] * 3)
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return LensPose(frame.stamp_ns, "world", T[:3, 3], quaternion, covariance)


def score(simulator: KneeSimulator, *, posed: bool, keep: Path | None = None) -> Scores:
    """Run the detector over a bench and score every image."""
    lens = simulator.lens
    camera = FisheyeCamera(
        lens.width_px, lens.height_px, lens.focal_px, lens.focal_px, lens.centre_x_px, lens.centre_y_px
    )
    detector, scores, check, track, points = GapEdgeTracker(), Scores(), GapCheck(simulator.truth), 0, None
    for frame in frames_of(simulator, keep):
        pose = lens_pose(frame)
        edges = detector.process(frame.stamp_ns, frame.image, camera, pose if posed else None)
        if frame.index % 10 == 0:
            scores.dice.append(dice(detector.gap_mask() > 0, frame.gap_mask))
        valid = edges.status is EdgeStatus.VALID
        if valid and edges.track_id != track:
            track, points = edges.track_id, simulator.points(frame, edges.pixels)
            scores.tracks += 1
            check.begin(track, points.points)
        check.add(frame, pose, edges, scores)
        if points is None:
            continue
        observations = simulator.follow(points, frame, edges=False)
        if observations.visible.all():
            scores.held.append(valid)
        if valid:
            judge(scores, edges, camera, observations.pixels)
    return scores.finish()


def judge(scores: Scores, edges: GapEdges, camera: FisheyeCamera, true_pixels: Array) -> None:
    """Add the errors of one image's bearings."""
    across = edges.pixels[1] - edges.pixels[0]
    across = across / np.linalg.norm(across)
    angles = []
    for index in (0, 1):
        true = camera.bearings(true_pixels[index])
        if not np.isfinite(true).all():
            continue
        error = edges.bearings[index] - true
        jacobian = bearing_jacobian(camera, edges.pixels[index])
        for values, direction in ((scores.across, across), (scores.along, np.array([-across[1], across[0]]))):
            axis = jacobian @ direction
            values.append(float(error @ axis / np.linalg.norm(axis)))
        angles.append(float(np.arccos(np.clip(true @ edges.bearings[index], -1.0, 1.0))))
        # The covariance of a unit vector has rank two.
        scores.nees.append(float(error @ np.linalg.pinv(edges.covariances[index], rcond=1e-6) @ error) / 2)
    if angles:
        scores.covered.append(max(angles) <= edges.angular_error)
        scores.bound.append(edges.angular_error)


def dice(mask: npt.NDArray[np.bool_], truth: npt.NDArray[np.bool_]) -> float:
    """Dice's coefficient of two masks."""
    return float(2 * (mask & truth).sum() / max(mask.sum() + truth.sum(), 1))


def main(argv: Sequence[str] | None = None) -> int:
    """Score the levels, directions and seeds asked for."""
    parser = argparse.ArgumentParser(prog="bench_edges", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--level", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--travel-direction", nargs="+", default=["along"])
    parser.add_argument("--seconds", type=float, default=1.0, help="of every track; the travel takes 3.3 s")
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--without-pose", action="store_true", help="follow the points by the images alone")
    parser.add_argument("--keep", type=Path, help="folder to keep rendered images in and take them from")
    asked = parser.parse_args(argv)
    for direction in asked.travel_direction:
        for level in asked.level:
            total = Scores()
            for seed in tqdm(asked.seed, desc=f"level {level} {direction}", disable=not sys.stderr.isatty()):
                try:
                    simulator = KneeSimulator(level, seed, direction, duration_s=asked.seconds, fps=asked.fps)
                except SimulationError as error:
                    print(f"bench_edges: {error}", file=sys.stderr)
                    return 1
                total.add(score(simulator, posed=not asked.without_pose, keep=asked.keep))
            print(f"level {level} {direction:8s} {total.line()}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
