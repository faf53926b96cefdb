"""The instrument gap of simulated bags beside its truth: process each bag and score its estimates.

    tools/run knee_gap_simulation make_bag out/knee --level 1 --seed 81000 --fps 15 --duration-s 3.5
    tools/env python bench/bench_gap.py out/knee ...

Each bag is processed with a calibration of its scope as `calibrate` would have found it, wrong by errors
drawn from what it states. A line a bag: VALID estimates, median error and bias, the shares whose bounds and
interval hold the truth, and the widths of the bounds of the gap and of the points' distance.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_bringup.simulated_calibration import simulated_calibration
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibration.calibration_file import save_calibration
from knee_gap_replay import process
from knee_gap_replay.report.comparison import Comparison, compare
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.recordings.scene_truth import scene_from_metadata


def line(found: Comparison) -> str:
    """Scores of the VALID estimates of one bag."""
    if not found.valid.any():
        return f"0 of {len(found.time)} VALID"

    def median_mm(values: Array) -> float:
        return float(1e3 * np.nanmedian(values[found.valid]))

    return (
        f"{found.valid.sum():3d} of {len(found.time)} VALID  |gap - truth| {1e3 * found.median_error:.3f} mm "
        f"(bias {median_mm(found.gap - found.truth):+.3f})  min <= truth {100 * found.above_minimum:.1f} %  "
        f"truth <= max {100 * found.below_maximum:.1f} %  95 % interval {100 * found.in_interval:.1f} %  "
        f"widths: bounds {1e3 * found.median_width:.2f} mm, "
        f"the points' {median_mm(found.point_distance_max - found.point_distance_min):.2f} mm, "
        f"interval {median_mm(found.confidence_max - found.confidence_min):.2f} mm  "
        f"truth {median_mm(found.truth):.2f} mm, points {median_mm(found.point_truth):.2f} mm"
    )


def measured(bag: Path, folder: Path) -> Comparison:
    """Process a bag into a folder and compare. Raises BagError or SimulationError if it cannot be used."""
    with BagReader(bag) as reader:
        truth = scene_from_metadata(reader.metadata)
    calibration, parameters = folder / "calibration.yaml", folder / "parameters.yaml"
    save_calibration(simulated_calibration(truth, 7), calibration)
    nodes = ("segmentation_node", "tracking_node")
    parameters.write_text(
        "".join(f"/**/{node}:\n  ros__parameters:\n    calibration_file: {calibration}\n" for node in nodes)
    )
    out = folder / "out"
    if process.main([str(bag), str(out), "--params-file", str(parameters)]):
        raise BagError(f"{bag} could not be processed")
    return compare(bag, out)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each bag."""
    parser = argparse.ArgumentParser(prog="bench_gap", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bags", nargs="*", type=Path)
    asked = parser.parse_args(argv)
    if not asked.bags:
        print("bench_gap: no bags are named: nothing is measured")
    for bag in tqdm(asked.bags, disable=not sys.stderr.isatty()):
        with tempfile.TemporaryDirectory() as folder:
            try:
                print(f"{bag.name:20s} {line(measured(bag, Path(folder)))}", flush=True)
            except (BagError, SimulationError) as error:
                print(f"bench_gap: {error}", file=sys.stderr)
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
