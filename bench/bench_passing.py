"""Wrong passes of an instrument that does not fit: knees whose true gap is known, without pictures.

Each run is a knee, a hand's travel, and what the nodes would be given of it: bearings of two true points of
the anatomy and of the true edges, wrong by errors drawn from their covariances, and lens poses with a
tracker's noise. The estimator's answers go to the example leg controller, whose instrument is 0.05 mm
thicker than the smallest true gap of the run. Printed: runs in which it was passed, the shares of VALID
estimates whose bounds and interval hold the truth, the median error, and the widths beside those of the
distance of the two points.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from tqdm import tqdm

from knee_gap_bringup.leg_control import Action, Estimate, LegControl, LegParameters
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.knee_views import ViewDrawer, edges_seen, points_beside
from knee_gap_simulation.recordings.section_truth import true_instrument_gap
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EXACT_SCOPE, EstimatorParameters

TOO_THICK = 0.05e-3


@dataclass
class Scores:
    """What the runs add up to; lengths [m]."""

    runs: int = 0
    passed: int = 0
    refused: int = 0
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def line(self) -> str:
        """All of it in one line."""
        if not self.rows:
            return f"{self.runs} runs, no valid estimate"
        gap, lower, upper, low, high, truth, points = np.array(self.rows).T
        return (
            f"{self.runs} runs ({self.refused} that do not fit into the joint left out), {len(gap)} valid  "
            f"passed an instrument {1e3 * TOO_THICK:.2f} mm too thick in {self.passed}  "
            f"gap_min <= truth {100 * np.mean(lower <= truth):.2f} %  truth <= gap_max "
            f"{100 * np.mean(truth <= upper):.2f} %  in the 95 % interval "
            f"{100 * np.mean((low <= truth) & (truth <= high)):.1f} %  |gap - truth| "
            f"{1e3 * np.median(np.abs(gap - truth)):.3f} mm (bias {1e3 * np.median(gap - truth):+.3f})  "
            f"[min, max] {1e3 * np.median(upper - lower):.2f} mm "
            f"wide, of the points {1e3 * np.median(points):.2f} mm"
        )


class Run:
    """One knee, seen along a hand's travel."""

    def __init__(self, level: int, seed: int, direction: str, fps: float) -> None:
        self._simulator = KneeSimulator(level, seed, direction, duration_s=3.0, fps=fps)
        self._drawer = ViewDrawer(np.random.default_rng([seed, 0x5041]))
        self._times = np.arange(0.3, 3.0, 1.0 / fps)
        scene = self._simulator.scene
        self._middle = scene.ridge(0.0)[0] - (0.0, 0.5 * (self._simulator.settings.gap or 0.0), 0.0)
        first = self._simulator.pose(float(self._times[0]))
        self._points = points_beside(scene, first, self._edges(first))

    def views(self) -> Iterator[tuple[GapEdges, LensPose, float]]:
        """Observation, tracked lens pose and true gap [m] of each image."""
        for time in self._times:
            T_scene_lens = self._simulator.pose(float(time))
            edges = self._edges(T_scene_lens)
            if not np.isfinite(edges).all():
                continue
            truth = true_instrument_gap(self._simulator.scene, T_scene_lens, edges).diameter
            stamp_ns = round(1e9 * (1.0 + time))
            observation = self._drawer.observation(stamp_ns, T_scene_lens, self._points, edges)
            yield observation, self._drawer.lens_pose(stamp_ns, T_scene_lens), truth

    def _edges(self, T_scene_lens: Array) -> Array:
        """True bearings (2, 3) of the edges through the middle of the gap, the condyle's first."""
        return edges_seen(self._simulator.scene, self._simulator.lens, T_scene_lens, self._middle)


def is_passed(estimates: Sequence[GapEstimate], diameter: float) -> bool:
    """Whether the example controller passes an instrument of a diameter [m] on any of the estimates."""
    parameters = LegParameters(instrument_diameter=diameter, largest_gap=diameter + 0.01)
    control = LegControl(parameters, -np.inf)
    for k, estimate in enumerate(estimates):
        if k == 0:
            # A leg at rest before the track begins.
            nothing = Estimate(False, 0, 0.02, np.nan, np.nan, np.nan, stamp_ns=estimate.stamp_ns - 10**8)
            for _ in range(2):
                control.on_estimate(nothing, 1e-9 * nothing.stamp_ns)
        heard = Estimate(
            is_valid=estimate.status is GapStatus.VALID,
            track_id=estimate.track_id,
            age=0.02,
            gap=estimate.gap,
            gap_min=estimate.gap_min,
            gap_max=estimate.gap_max,
            stamp_ns=estimate.stamp_ns,
        )
        if control.on_estimate(heard, 1e-9 * estimate.stamp_ns).action is Action.PASS:
            return True
    return False


def score(run: Run, scores: Scores) -> None:
    """Add a run."""
    estimator = GapEstimator(EstimatorParameters(**EXACT_SCOPE))
    truths: dict[int, float] = {}
    estimates: list[GapEstimate] = []
    for edges, pose, truth in run.views():
        truths[edges.stamp_ns] = truth
        estimates += estimator.add_pose(pose, pose.stamp_ns)
        estimates += estimator.add_edges(edges, edges.stamp_ns)
    scores.runs += 1
    if not truths:
        return
    scores.passed += is_passed(estimates, min(truths.values()) + TOO_THICK)
    for one in estimates:
        if one.status is GapStatus.VALID:
            scores.rows.append(
                (
                    one.gap,
                    one.gap_min,
                    one.gap_max,
                    one.confidence_min,
                    one.confidence_max,
                    truths[one.stamp_ns],
                    one.point_distance_max - one.point_distance_min,
                )
            )


def main(argv: Sequence[str] | None = None) -> int:
    """Score the levels, directions and runs asked for."""
    parser = argparse.ArgumentParser(prog="bench_passing", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=88000, help="of the first run")
    parser.add_argument("--level", type=int, nargs="+", default=[1])
    parser.add_argument("--travel-direction", nargs="+", default=["along"])
    parser.add_argument("--fps", type=float, default=10.0)
    asked = parser.parse_args(argv)
    for direction in asked.travel_direction:
        for level in asked.level:
            scores = Scores()
            seeds = range(asked.seed, asked.seed + asked.runs)
            for seed in tqdm(seeds, desc=f"level {level} {direction}", disable=not sys.stderr.isatty()):
                try:
                    score(Run(level, seed, direction, asked.fps), scores)
                except SimulationError:
                    scores.refused += 1
            print(f"level {level} {direction:8s} {scores.line()}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
