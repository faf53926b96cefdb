"""Confusion of a calibration, wrong by as much as it states, with a joint that moves.

    tools/env python bench/bench_wrong_scope.py --tracks 100

Tracks of 150 images at 60 Hz from a scope that travels 20 mm and turns by 20 degrees past two points at rest,
its error drawn from what is stated. Ends with 1 where more than 1 track in 100 ends with JOINT_MOVED, or a
valid estimate does not hold the truth.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.studies.wrong_calibration.simulated_scope import POINTS, wrong_scope

# Shift [m], turn [rad], clock [s], RMS.
SCOPES = {
    "0.02 mm, 0.015 deg, 0.04 ms": (2e-5, np.radians(0.015), 4e-5),
    "1 mm": (1e-3, 1e-9, 1e-9),
    "3 mm": (3e-3, 1e-9, 1e-9),
    "1 deg": (1e-9, np.radians(1.0), 1e-9),
    "3 deg": (1e-9, np.radians(3.0), 1e-9),
    "5 ms": (1e-9, 1e-9, 5e-3),
    "2 mm, 1.5 deg, 3 ms": (2e-3, np.radians(1.5), 3e-3),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line a scope."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tracks", type=int, default=100, help="of each scope")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args(argv)
    gap, failed = float(np.linalg.norm(POINTS[1] - POINTS[0])), False
    for name, (shift, turn, clock) in SCOPES.items():
        ended = valid = missed = images = 0
        for seed in range(arguments.first, arguments.first + arguments.tracks):
            estimates = wrong_scope(seed, shift, turn, clock)
            ended += any(one.status is GapStatus.JOINT_MOVED for one in estimates)
            numbers = [one for one in estimates if one.status is GapStatus.VALID]
            images, valid = images + len(estimates), valid + len(numbers)
            missed += sum(not one.gap_min <= gap <= one.gap_max for one in numbers)
        print(
            f"{name}: JOINT_MOVED in {ended} of {arguments.tracks} tracks; {valid} of {images} images valid, "
            f"the truth outside {missed} of their bounds",
            flush=True,
        )
        failed |= ended > 0.01 * arguments.tracks or missed > 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
