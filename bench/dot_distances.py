"""Distances of known dots by motion stereo with a real tracked laparoscope, unseen by the calibration.

    tools/env python bench/dot_distances.py FOLDER

FOLDER holds a session as `calib.left.points.N.txt` (id, column, row), `calib.tracking.N.4x4` (body in the
tracker's frame, mm) and, there or above, `*_centres.txt` (id, x, y, z in mm). Three ways: calibrated on all
and measured on the same; on the dots of even number and measured on the odd ones, and the reverse; on all
views but one, and measured between that view and each of the others. Every true distance has to lie in its
range.
"""

import argparse
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.errors import MeasurementError
from knee_gap_perception.calibrate.measurements.boards import BoardView
from knee_gap_perception.calibrate.solvers import hand_eye, intrinsics
from knee_gap_perception.calibrate.solvers.hand_eye import HandEye, calibrate_hand_eye
from knee_gap_perception.calibrate.solvers.hand_eye_bundle import TrackedView
from knee_gap_perception.calibrate.solvers.intrinsics import fit_intrinsics
from knee_gap_perception.calibrate.solvers.lens_error import lens_errors
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_uncertainty.two_view.gap_range import gap_range

Views = list[TrackedView]
MODELS = ("plumb_bob", "equidistant")


class Tally(NamedTuple):
    """Ratios of measured to true distances, widths of the ranges to them, how many lie inside or had none."""

    ratios: list[float]
    widths: list[float]
    inside: int
    refused: int

    def line(self, name: str) -> str:
        """One line of the table."""
        if not self.ratios:
            return f"{name}: nothing measured, {self.refused} refused"
        low, middle, high = np.percentile(self.ratios, [5, 50, 95])
        return (
            f"{name}: inside {self.inside} of {len(self.ratios)}, {self.refused} refused; ratio to the truth "
            f"{middle:.3f} [{low:.3f}, {high:.3f}], range over truth {np.median(self.widths):.2f}, "
            f"{np.isinf(self.widths).sum()} unbounded"
        )


def session(folder: Path, centres: Path) -> Views:
    """The views of a session, in metres."""
    model = {int(row[0]): row[1:4] * 1e-3 for row in np.loadtxt(centres)}
    views = []
    for index, path in enumerate(sorted(folder.glob("calib.left.points.*.txt"))):
        rows = np.loadtxt(path)
        ids = rows[:, 0].astype(int)
        T = np.loadtxt(folder / f"calib.tracking.{index}.4x4")
        T[:3, 3] *= 1e-3
        board = BoardView(index, ids, np.array([model[i] for i in ids]), rows[:, 1:])
        views.append(TrackedView(board, T, np.zeros(6)))
    return views


def calibrated(views: Views, size: tuple[int, int], model: LensModel) -> HandEye:
    """Camera and hand-eye of the views."""
    fit = fit_intrinsics([view.board for view in views], *size, model)
    return calibrate_hand_eye(views, fit.intrinsics, model)


def only(views: Views, divisor: int, remainder: int) -> Views:
    """The views with those of their dots whose numbers leave a remainder."""
    kept = []
    for view in views:
        mask = view.board.ids % divisor == remainder
        board = view.board
        board = BoardView(board.stamp_ns, board.ids[mask], board.points[mask], board.pixels[mask])
        kept.append(view._replace(board=board))
    return kept


def measured(found: HandEye, pairs: Sequence[tuple[TrackedView, TrackedView]], seed: int) -> Tally:
    """Distances of 25 pairs of dots in each pair of views."""
    camera, rng = found.intrinsics.camera(), np.random.default_rng(seed)
    ratios: list[float] = []
    widths: list[float] = []
    inside = refused = 0
    for first, second in pairs:
        ids, in_first, in_second = np.intersect1d(first.board.ids, second.board.ids, return_indices=True)
        lens = [view.T_world_body @ found.T_body_lens for view in (first, second)]
        translation_error, angular_error = lens_errors(first.T_world_body, second.T_world_body, found)
        bearings = [
            camera.bearings(view.board.pixels[chosen]) @ T[:3, :3].T
            for view, chosen, T in zip((first, second), (in_first, in_second), lens, strict=True)
        ]
        points = first.board.points[in_first]
        all_pairs = list(combinations(range(len(ids)), 2))
        for k in rng.choice(len(all_pairs), min(25, len(all_pairs)), replace=False):
            chosen = list(all_pairs[k])
            true = float(np.linalg.norm(np.diff(points[chosen], axis=0)))
            try:
                bounds = gap_range(
                    lens[0][:3, 3], lens[1][:3, 3], bearings[0][chosen], bearings[1][chosen],
                    angular_error=angular_error, translation_error=translation_error, apex="best",
                )  # fmt: skip
            except MeasurementError:
                refused += 1
                continue
            ratios.append(bounds.gap / true)
            widths.append((bounds.gap_max - bounds.gap_min) / true)
            inside += bounds.gap_min <= true <= bounds.gap_max
    return Tally(ratios, widths, inside, refused)


def joined(tallies: Sequence[Tally]) -> Tally:
    """All of them as one."""
    return Tally(
        [ratio for tally in tallies for ratio in tally.ratios],
        [width for tally in tallies for width in tally.widths],
        sum(tally.inside for tally in tallies),
        sum(tally.refused for tally in tallies),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 1 where a true distance lies outside or a median ratio is off by more than 5 %."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path, help="session")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 540), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seeds", type=int, default=4)
    arguments = parser.parse_args(argv)
    beside = [*arguments.folder.glob("*_centres.txt"), *arguments.folder.parent.glob("*_centres.txt")]
    if not beside:
        print(f"no *_centres.txt in {arguments.folder} or above it", file=sys.stderr)
        return 2
    views, size = session(arguments.folder, beside[0]), tuple(arguments.size)
    # Three views are one fewer than the command asks for: they are all that is left of four.
    hand_eye.MIN_VIEWS = intrinsics.MIN_VIEWS = min(hand_eye.MIN_VIEWS, len(views) - 1)
    good = True
    for name in MODELS:
        model, everything = LensModel(name), list(combinations(views, 2))
        found = calibrated(views, size, model)
        sigma = np.sqrt(np.trace(found.covariance[3:, 3:])) * 1e3
        print(f"{name}: lens known to {sigma:.1f} mm RMS from {len(views)} views")
        tables = {"in sample": joined([measured(found, everything, s) for s in range(arguments.seeds)])}
        by_dots = []
        for parity in (0, 1):
            found = calibrated(only(views, 2, parity), size, model)
            rest = only(views, 2, 1 - parity)
            by_dots += [measured(found, list(combinations(rest, 2)), s) for s in range(arguments.seeds)]
        tables["dots that the calibration has not seen"] = joined(by_dots)
        by_views = []
        for index, left_out in enumerate(views):
            rest = [*views[:index], *views[index + 1 :]]
            try:
                found = calibrated(rest, size, model)
            except PerceptionError as error:
                print(f"  without view {index}: {error}")
                continue
            by_views += [
                measured(found, [(left_out, view) for view in rest], s) for s in range(arguments.seeds)
            ]
        tables["views that the calibration has not seen"] = joined(by_views)
        for title, tally in tables.items():
            print("  " + tally.line(title))
            good &= bool(tally.ratios) and tally.inside == len(tally.ratios)
            good &= bool(tally.ratios) and abs(float(np.median(tally.ratios)) - 1.0) <= 0.05
    print(
        "every true distance inside, medians within 5 %"
        if good
        else "NOT all inside, or a median off by > 5 %"
    )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
