"""The command `compare_looks`: statistics of plain and real looks, beside real pictures."""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import KneeGapError
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import LEVELS
from knee_gap_simulation.look_checks.contact_sheet import moment, read_frames
from knee_gap_simulation.looks.look import Appearance
from knee_gap_simulation.looks.statistics import known, separability, table

_LEAST = 8
_MOST_OF_A_VIDEO = 6
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm")


def compared(seeds: Sequence[int], real: Array | None) -> str:
    """The report on both looks of the seeds, at levels in turn, and on features (n, k) of real pictures."""
    groups = {}
    for appearance in Appearance:
        images = []
        for index, seed in enumerate(
            tqdm(seeds, desc=appearance, unit="image", disable=not sys.stderr.isatty())
        ):
            images.append(moment(LEVELS[index % len(LEVELS)], seed, appearance))
        groups[f"rendered, {appearance}"] = known(images)
    lines = [table(groups if real is None else {**groups, "pictures": real})]
    if real is not None:
        lines.append("")
        for name, values in groups.items():
            rate = separability(values, real)
            lines.append(f"distinguished from pictures, {name}: {100.0 * rate:.0f} % (chance 50 %)")
        half = np.arange(len(real)) % 2 == 0
        if min(half.sum(), (~half).sum()) >= _LEAST:
            rate = separability(real[half], real[~half])
            lines.append(f"distinguished, every other picture from the rest: {100.0 * rate:.0f} %")
    return "\n".join(lines)


def pictures(paths: Sequence[Path]) -> Array:
    """Features (n, k) of all pictures in files, folders and videos; a few frames of each video."""
    found = []
    for path in paths:
        inside = sorted(path.iterdir()) if path.is_dir() else [path]
        found += [
            frame
            for file in inside
            if file.suffix.lower() in (".png", ".jpg", ".jpeg", *_VIDEOS)
            for frame in read_frames(file, _MOST_OF_A_VIDEO)
        ]
    values = known(found)
    if len(values) < _LEAST:
        raise SimulationError(f"{len(values)} pictures with a field are too few: at least {_LEAST}")
    return values


def main(argv: Sequence[str] | None = None) -> int:
    """Print the comparison; return 0 if it is printed."""
    parser = Parser(prog="compare_looks", description=__doc__)
    parser.add_argument("--first-seed", type=int, default=300, help="first seed (300)")
    parser.add_argument("--count", type=int, default=40, help="renders of each appearance (40)")
    parser.add_argument(
        "--pictures",
        type=Path,
        nargs="*",
        default=[],
        help="real pictures: files, folders of them, or videos",
    )
    arguments = parser.parse_args(argv)
    try:
        if arguments.count < _LEAST or arguments.first_seed < 0:
            raise SimulationError(f"at least {_LEAST} renders, and a seed that is not negative")
        real = pictures(arguments.pictures) if arguments.pictures else None
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.count)
        print(compared(seeds, real))
    except (KneeGapError, OSError) as error:
        print(f"compare_looks: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("compare_looks: stopped before the end", file=sys.stderr)
        return 130
    return 0
