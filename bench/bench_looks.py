"""Accuracy on knees that look real: of meshes, medial and lateral, and the procedural one.

    tools/env python bench/bench_looks.py --seed 1 2 3 4 5

Each bag is rendered with `--appearance real` at a low frame rate, processed with a calibration of its scope
that is wrong by what it states, and compared with its truth, as bench_gap does. Needed of the VALID
estimates of a knee: truth in [min, max] in at least 99 %, in the 95 % interval in 90-99 %, median error at
most 0.3 mm; and tracks kept in at least 80 % of the images. Kept are images with valid edges, from the first
track on, while tissue or probe hides neither of its two points; an image in which debris does counts as lost.
Meshes need `make anatomy` and a folder of them; without it they are left out.
"""

import argparse
import contextlib
import importlib.util
import io
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from bench_gap import line, measured
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_core.values.rigid_transforms import inverse, rigid
from knee_gap_core.values.stamps import stamp_ns
from knee_gap_replay.report.comparison import EDGES, Comparison
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import Anatomy, KneeSimulator
from knee_gap_simulation.make_bag.command import make_knee_bag
from knee_gap_simulation.recordings.recording import LENS_POSE_TRUE
from knee_gap_simulation.recordings.scene_truth import SceneTruth, scene_from_metadata

MESHES = Path(__file__).resolve().parents[2] / "shared" / "data" / "anatomy"
PROCEDURAL = "procedural"
SAME_POINT = 0.3e-3  # [m] by which what is seen at a point's pixel may differ from it


@dataclass
class Knees:
    """Scores of many bags of one kind of knee."""

    bags: int = 0
    found: int = 0
    estimates: int = 0
    kept: list[bool] = field(default_factory=list)
    columns: list[Array] = field(default_factory=list)

    def add(self, compared: Comparison, kept: Sequence[bool]) -> None:
        """Add the estimates of one bag, and which of its images with visible points have valid edges."""
        self.bags += 1
        self.found += bool(kept)
        self.estimates += len(compared.time)
        self.kept += kept
        low, high = compared.confidence_min, compared.confidence_max
        rows = np.stack([compared.gap, compared.gap_min, compared.gap_max, low, high, compared.truth], axis=1)
        self.columns.append(rows[compared.valid])

    def row(self) -> str:
        """Cells of a Markdown table."""
        rows = np.concatenate(self.columns) if self.columns else np.zeros((0, 6))
        gap, least, most, low, high, truth = rows.T
        known = np.isfinite(truth)

        def percent(held: Array) -> str:
            return f"{100 * held.mean():.1f} %" if held.size else "-"

        def millimetres(values: Array) -> str:
            return f"{1e3 * np.median(values):.2f} mm" if values.size else "-"

        return (
            f"{self.found} of {self.bags} | {percent(np.array(self.kept))} | "
            f"{len(rows)} of {self.estimates} | "
            f"{percent((least <= truth) & (truth <= most))} | {percent((low <= truth) & (truth <= high))} | "
            f"{millimetres(np.abs(gap - truth)[known])} | {millimetres((gap - truth)[known])} | "
            f"{millimetres(most - least)} | {millimetres(high - low)} | {millimetres(truth[known])}"
        )


HEAD = (
    "| knee | gap found in | images kept | VALID | in [min, max] | in the 95 % interval | median error "
    "| bias | width of [min, max] | of the interval | truth |"
)


def simulator(knee: str, seed: int, asked: argparse.Namespace) -> KneeSimulator:
    """The knee of a seed: of meshes, by the name of its compartment, or procedural."""
    anatomy = None
    if knee != PROCEDURAL:
        anatomy = Anatomy(asked.anatomy, compartment=knee, flexion=float(np.radians(asked.flexion_deg)))
    return KneeSimulator(
        asked.level,
        seed,
        asked.travel_direction,
        duration_s=asked.seconds,
        fps=asked.fps,
        appearance=asked.appearance,
        anatomy=anatomy,
    )


def images_kept(bag: Path, out: Path) -> list[bool]:
    """Of the images from the first track on in which both its points are visible: whether edges are valid."""
    poses: dict[int, Array] = {}
    with BagReader(bag) as reader:
        scene = scene_from_metadata(reader.metadata)
        for entry in reader.messages([LENS_POSE_TRUE]):
            message = reader.deserialize(entry)
            p, q = message.pose.position, message.pose.orientation
            turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
            poses[stamp_ns(message.header)] = rigid(turned, [p.x, p.y, p.z])
    kept, track, points = [], 0, np.full((2, 3), np.nan)
    with BagReader(out) as reader:
        for entry in reader.messages([EDGES]):
            edges = reader.deserialize(entry)
            stamp = stamp_ns(edges.header)
            valid = edges.status == EdgeStatus.VALID
            if valid and edges.track_id != track:
                track = edges.track_id
                points = scene.surface_points(poses[stamp], np.array([edges.pixel_0, edges.pixel_1]), stamp)
            if track and visible(scene, poses[stamp], points, stamp):
                kept.append(valid)
    return kept


def visible(scene: SceneTruth, T_world_lens: Array, points: Array, stamp: int) -> bool:
    """Whether nothing but debris hides points (n, 3) [m] of the world from a lens pose (4, 4)."""
    T_lens_world = inverse(T_world_lens)
    pixels = scene.lens.pixels(points @ T_lens_world[:3, :3].T + T_lens_world[:3, 3])
    seen = scene.surface_points(T_world_lens, pixels, stamp)
    return bool((np.linalg.norm(seen - points, axis=1) < SAME_POINT).all())


def score(knee: str, seed: int, asked: argparse.Namespace, folder: Path) -> tuple[Comparison, list[bool]]:
    """Render and process one bag into a folder. Raises BagError or SimulationError."""
    bag = folder / "bag"
    if asked.keep is not None:
        bag = asked.keep / f"{knee}_{asked.level}_{seed}_{asked.travel_direction}_{asked.appearance}"
    if not bag.exists():
        make_knee_bag(bag, simulator(knee, seed, asked), progress=False)
    # The commands' own words are of each bag's folder, which is gone afterwards.
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as words:
        try:
            compared = measured(bag, folder)
        except BagError as error:
            raise BagError(f"{error}: {words.getvalue().strip()}") from error
    return compared, images_kept(bag, folder / "out")


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each bag, and a row for each kind of knee."""
    parser = argparse.ArgumentParser(prog="bench_looks", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--knee", nargs="+", default=["medial", "lateral", PROCEDURAL])
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--level", type=int, default=1)
    parser.add_argument("--travel-direction", default="along")
    parser.add_argument("--appearance", default="real", choices=["real", "plain"])
    parser.add_argument("--seconds", type=float, default=3.5)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--flexion-deg", type=float, default=25.0)
    parser.add_argument("--anatomy", type=Path, default=MESHES, metavar="FOLDER", help="of the meshes")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where bags are kept, and taken from")
    asked = parser.parse_args(argv)
    knees = [knee for knee in asked.knee if knee == PROCEDURAL or has_meshes(asked.anatomy)]
    rows = [HEAD, "|---" * HEAD.count(" | ") + "|---|"]
    for knee in knees:
        total = Knees()
        for seed in tqdm(asked.seed, desc=knee, disable=not sys.stderr.isatty()):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    compared, kept = score(knee, seed, asked, Path(folder))
                except SimulationError as error:
                    print(f"bench_looks: {knee} {seed} left out: {error}", file=sys.stderr)
                    continue
                except BagError as error:
                    print(f"bench_looks: {error}", file=sys.stderr)
                    return 1
            total.add(compared, kept)
            share = f"{np.mean(kept):4.0%}" if kept else "  - "
            print(f"{knee:10s} {seed:6d}  kept {share}  {line(compared)}", flush=True)
        rows.append(f"| {knee} | {total.row()} |")
    print("\n".join(rows))
    return 0


def has_meshes(folder: Path) -> bool:
    """Whether meshes can be had; says so if not."""
    if importlib.util.find_spec("trimesh") is None:
        print("bench_looks: meshes need `make anatomy`, they are left out")
        return False
    if not folder.is_dir():
        print(f"bench_looks: no {folder}, meshes are left out")
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
