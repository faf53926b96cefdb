"""Calibrations of simulated scopes against their truth: how far off, and whether the stated errors cover it.

    tools/env python bench/bench_calibration.py --board dots --lens pinhole --first 200 --seeds 8

Makes a calibration bag a seed, calibrates from it with the commands a user has, and prints the lens's error,
its normalised square (NEES, 6 degrees of freedom), and the clock's error. Ends with 1 where a lens is off by
more than 0.2 mm or 0.2 degrees, a clock by more than 1 ms, or a truth lies outside 99.9 % of what was stated.
"""

import argparse
import contextlib
import io
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from knee_gap_core.values.rigid_transforms import inverse, to_vector
from knee_gap_perception.calibrate.command import main as calibrate
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_simulation.calibration.bag import (
    BOARDS,
    LENSES,
    CalibrationRecording,
    calibration_truth,
    make_calibration_bag,
)

MODELS = {"equidistant": "equidistant", "pinhole": "plumb_bob"}
MOST_SHIFT, MOST_TURN, MOST_TIME = 0.2e-3, np.radians(0.2), 1e-3


def judged(recording: CalibrationRecording, folder: Path, views: int) -> tuple[float, bool]:
    """NEES of one scope's lens, and whether all is within the limits; prints the line."""
    truth, bag, into = calibration_truth(recording), folder / "bag", folder / "calibration.yaml"
    make_calibration_bag(bag, recording)
    board = ["--board", truth.board.text, "--into", str(into), "--views", str(views)]
    model = ["--model", MODELS[recording.lens]]
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        codes = [
            calibrate(["intrinsics", str(bag), *board, *model]),
            calibrate(["hand_eye", str(bag), *board]),
        ]
    if any(codes):
        print(f"seed {recording.seed}: refused: {output.getvalue().strip().splitlines()[-1]}", flush=True)
        return float("nan"), False
    found = load_calibration(into)
    lens, clock = found.require_lens(), found.clock
    assert clock is not None
    error = to_vector(inverse(lens.T_body_lens) @ truth.scope.body_to_lens(0.0))
    turn, shift = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    stated = np.sqrt([np.trace(lens.covariance[3:, 3:]), np.trace(lens.covariance[:3, :3])])
    nees = float(error @ np.linalg.solve(lens.covariance, error))
    late = clock.offset - truth.time_offset
    print(
        f"seed {recording.seed}: lens off by {1e3 * shift:.4f} mm (stated {1e3 * stated[0]:.4f} RMS), "
        f"{np.degrees(turn):.4f} deg ({np.degrees(stated[1]):.4f}); NEES {nees:.2f}; "
        f"clock off by {1e3 * late:+.4f} ms ({late / clock.sigma:+.2f} sigma)",
        flush=True,
    )
    within = shift < MOST_SHIFT and turn < MOST_TURN and abs(late) < MOST_TIME
    return nees, within and nees < float(chi2.ppf(0.999, 6)) and abs(late) < 3.29 * clock.sigma


def main(argv: Sequence[str] | None = None) -> int:
    """Judge some seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--board", choices=BOARDS, default="charuco")
    parser.add_argument("--lens", choices=LENSES, default="equidistant")
    parser.add_argument("--first", type=int, default=200, help="first seed")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--board-s", type=float, default=16.0, help="length of the recording [s]")
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--views", type=int, default=40)
    arguments = parser.parse_args(argv)
    results = []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        recording = CalibrationRecording(
            seed=seed, fps=arguments.fps, board_s=arguments.board_s, oblique_s=0.0, pivot_s=0.0,
            board=arguments.board, lens=arguments.lens,
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            results.append(judged(recording, Path(folder), arguments.views))
    nees = np.array([one for one, _ in results])
    known = nees[np.isfinite(nees)]
    freedom = 6 * len(known)
    print(
        f"{arguments.board}, {arguments.lens}: "
        f"{sum(good for _, good in results)} of {len(results)} within the limits; "
        f"{int((known < chi2.ppf(0.95, 6)).sum())} of {len(known)} inside the stated 95 %; "
        f"sum of NEES {known.sum():.1f} (exact: {chi2.ppf(0.025, freedom):.0f} to "
        f"{chi2.ppf(0.975, freedom):.0f}; below: stated larger than it is)"
    )
    return 0 if all(good for _, good in results) else 1


if __name__ == "__main__":
    sys.exit(main())
