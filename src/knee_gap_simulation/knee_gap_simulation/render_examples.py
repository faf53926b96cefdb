"""The command `render_examples`: pictures of many knees with the class of each pixel, to train on."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_core.values.errors import KneeGapError
from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import LEVELS
from knee_gap_simulation.knee_simulator import FROM_SEED, KneeSimulator, SimulatorFrame
from knee_gap_simulation.looks.look import Appearance
from knee_gap_simulation.scope.imaging import ByteImage
from knee_gap_simulation.scope.lens import Lens

CLIPPED = 250  # [grey levels] from which all channels are clipped: glare
COVERED = 0.5  # share of a pixel covered by debris from which its class is not known
CLOSED_SHARE = 0.3  # of the knees, without a gap
POSES = 3  # pictures of a knee
DIRECTIONS = ("along", "across", "forward")
MOST_TRIES = 4  # travels, ever shorter, until one fits into the joint


@dataclass(frozen=True)
class LabelledPicture:
    """A picture (h, w, 3), blue green red, and the `PixelClass` of each pixel (h, w), with its name."""

    name: str
    image: ByteImage
    labels: ByteImage


def examples(seeds: Sequence[int], reduction: float = 3.0) -> Iterator[LabelledPicture]:
    """`POSES` pictures of the knee of each seed, made smaller by `reduction`."""
    for seed in seeds:
        rng = np.random.default_rng([seed, 0x4C4142])
        simulator = _knee(seed, rng, reduction)
        first, last = sorted(rng.integers(0, simulator.frame_count, 2).tolist())
        step = max(1, (last - first) // (POSES - 1))
        for frame in simulator.frames(first, first + POSES * step, step):
            yield LabelledPicture(
                f"{seed:06d}_{frame.index:03d}", frame.image, labels_of(frame, simulator.lens)
            )


def labels_of(frame: SimulatorFrame, lens: Lens) -> ByteImage:
    """`PixelClass` of each pixel (h, w) of a frame; where debris covers the tissue, it is unknown."""
    labels = np.full(frame.image.shape[:2], PixelClass.TISSUE, np.uint8)
    labels[frame.gap_mask] = PixelClass.GAP
    labels[frame.instrument_mask] = PixelClass.INSTRUMENT
    labels[frame.image.min(axis=2) >= CLIPPED] = PixelClass.GLARE
    labels[frame.debris_cover > COVERED] = UNKNOWN_CLASS
    labels[np.isnan(lens.bearings(lens.pixel_grid())[..., 0])] = PixelClass.OUTSIDE
    return labels


def _knee(seed: int, rng: np.random.Generator, reduction: float) -> KneeSimulator:
    level, direction = int(rng.choice(LEVELS)), str(rng.choice(DIRECTIONS))
    gap = None if rng.random() < CLOSED_SHARE else FROM_SEED
    travel = 0.008
    for attempt in range(MOST_TRIES):
        try:
            return KneeSimulator(
                level,
                seed,
                direction,
                gap=gap,
                travel=travel,
                workers=1,
                appearance=Appearance.REAL,
                reduction=reduction,
            )
        except SimulationError:
            if attempt == MOST_TRIES - 1:
                raise
            travel /= 2.0
    raise AssertionError


def main(argv: Sequence[str] | None = None) -> int:
    """Write the pictures; return 0 if all are written."""
    parser = Parser(prog="render_examples", description=__doc__)
    parser.add_argument("out", type=Path, help="new folder for pictures (.jpg) and their labels (.png)")
    parser.add_argument("--first-seed", type=int, default=20000, help="seed of the first knee (20000)")
    parser.add_argument(
        "--knees", type=int, default=400, help=f"number of knees, {POSES} pictures each (400)"
    )
    asked = parser.parse_args(argv)
    try:
        if asked.first_seed < 0 or asked.knees < 1:
            raise SimulationError("at least one knee, and a seed that is not negative")
        if asked.out.exists():
            raise SimulationError(f"{asked.out} exists already")
        asked.out.mkdir(parents=True)
        count = _write(asked.out, range(asked.first_seed, asked.first_seed + asked.knees))
    except (KneeGapError, OSError) as error:
        print(f"render_examples: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("render_examples: stopped before the end", file=sys.stderr)
        return 130
    print(f"{asked.out}: {count} pictures")
    return 0


def _write(out: Path, seeds: Sequence[int]) -> int:
    """Write the pictures of seeds; a knee that the travel does not fit into is left out and named."""
    count = 0
    for seed in tqdm(seeds, desc="rendering", unit="knee", disable=not sys.stderr.isatty()):
        try:
            for example in examples([seed]):
                cv2.imwrite(str(out / f"{example.name}.jpg"), example.image)
                cv2.imwrite(str(out / f"{example.name}.png"), example.labels)
                count += 1
        except SimulationError as error:
            print(f"render_examples: seed {seed} is left out: {error}", file=sys.stderr)
    return count
