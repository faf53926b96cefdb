"""The edges of the gap on simulated knees whose truth is known, level by level, on seeds of your choice.

A track is scored from its first image on: the surface points behind its first two pixels are its truth.
Errors are told along and across the edge, in degrees; NEES is the squared error in units of its own
covariance, against its expectation; held is the share of images with a valid track while both are to be seen.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from knee_gap_perception.camera import FisheyeCamera, bearing_jacobian
from knee_gap_perception.edge_detector import GapEdgeDetector
from knee_gap_perception.edges import EdgeStatus, GapEdges
from knee_gap_perception.poses import LensPose
from knee_gap_simulation.bench import Bench, BenchFrame
from knee_gap_simulation.errors import SimulationError

Array = npt.NDArray[np.float64]

# Errors of the tracked lens: the paper's RMS lengths, per axis, and the lever from the body to the lens.
POSITION_ERROR = float(np.hypot(0.0367e-3, 0.2 * np.radians(0.004)) / np.sqrt(3))
ROTATION_ERROR = float(np.radians(0.004) / np.sqrt(3))


@dataclass
class Scores:
    """What the images of one track, or of many, add up to."""

    along: list[float] = field(default_factory=list)
    across: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    covered: list[bool] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    dice: list[float] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    tracks: int = 0

    def add(self, other: "Scores") -> None:
        """Take in the images of another track."""
        for name in ("along", "across", "nees", "covered", "bound", "dice", "held"):
            getattr(self, name).extend(getattr(other, name))
        self.tracks += other.tracks

    def line(self) -> str:
        """All of it in one line."""

        def rms(values: list[float]) -> float:
            return float(np.degrees(np.sqrt(np.mean(np.square(values))))) if values else float("nan")

        def mean(values: Sequence[float]) -> float:
            return float(np.mean(values)) if values else float("nan")

        bound = np.degrees(np.median(self.bound)) if self.bound else float("nan")
        return (
            f"Dice {mean(self.dice):.3f}  "
            f"along {rms(self.along):.2f} deg  across {rms(self.across):.2f} deg  "
            f"bound {bound:.2f} deg holds {100 * mean(self.covered):.1f} %  NEES {mean(self.nees):.2f}  "
            f"held {100 * mean(self.held):.0f} %  tracks {self.tracks}"
        )


def lens_pose(frame: BenchFrame) -> LensPose:
    """The tracked pose of the lens, as tracking_node would publish it."""
    T = frame.T_world_lens_tracked
    covariance = np.diag([POSITION_ERROR**2] * 3 + [ROTATION_ERROR**2] * 3)
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return LensPose(frame.stamp_ns, "world", "arthroscope_optical", T[:3, 3], quaternion, covariance)


def score(bench: Bench, *, posed: bool) -> Scores:
    """Run the detector over a bench and score every image."""
    lens = bench.lens
    camera = FisheyeCamera(
        lens.width_px, lens.height_px, lens.focal_px, lens.focal_px, lens.centre_x_px, lens.centre_y_px
    )
    detector, scores, track, points = GapEdgeDetector(), Scores(), 0, None
    for frame in bench.frames():
        edges = detector.process(frame.stamp_ns, frame.image, camera, lens_pose(frame) if posed else None)
        if frame.index % 10 == 0:
            scores.dice.append(dice(detector.gap_mask() > 0, frame.gap_mask))
        valid = edges.status is EdgeStatus.VALID
        if valid and edges.track_id != track:
            track, points = edges.track_id, bench.points(frame, edges.pixels)
            scores.tracks += 1
        if points is None:
            continue
        sightings = bench.follow(points, frame)
        if sightings.visible.all():
            scores.held.append(valid)
        if valid:
            judge(scores, edges, camera, sightings.pixels)
    return scores


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
    asked = parser.parse_args(argv)
    for direction in asked.travel_direction:
        for level in asked.level:
            total = Scores()
            for seed in tqdm(asked.seed, desc=f"level {level} {direction}", disable=not sys.stderr.isatty()):
                try:
                    bench = Bench(level, seed, direction, duration_s=asked.seconds, fps=asked.fps)
                except SimulationError as error:
                    print(f"bench_edges: {error}", file=sys.stderr)
                    return 1
                total.add(score(bench, posed=not asked.without_pose))
            print(f"level {level} {direction:8s} {total.line()}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
