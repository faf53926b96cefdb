"""The decision under colour casts and with instruments in view: gaps lost, false gaps, points on them.

    tools/env python bench/bench_casts.py --seed $(seq 6001 6030) --level 0 1 2

One image each of open and closed simulated knees is looked at as it is rendered and with its channels
multiplied, as by a camera's white balance; what exceeds the display's range is clipped. Lost are open joints
whose gap is found as rendered and not with the cast; at most 5 % may be. Of closed joints at most 2 % may be
called a gap. With --instruments, images are taken while one is in view, of every kind and finish if the
appearance is real.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_segmentation import GOLDEN
from kept_frames import frames_of
from tqdm import tqdm

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import FROM_SEED, KneeSimulator, SimulatorFrame
from knee_gap_simulation.scope.hand_motion import TravelDirection

# Gains of blue, green, red.
CASTS = {
    "as rendered": (1.0, 1.0, 1.0),
    "blue x 0.80": (0.80, 1.0, 1.0),
    "blue x 0.90": (0.90, 1.0, 1.0),
    "blue x 1.10": (1.10, 1.0, 1.0),
    "blue x 1.20": (1.20, 1.0, 1.0),
    "blue x 1.35": (1.35, 1.0, 1.0),
    "green x 0.85": (1.0, 0.85, 1.0),
    "green x 1.15": (1.0, 1.15, 1.0),
    "green x 1.25": (1.0, 1.25, 1.0),
    "red x 0.85": (1.0, 1.0, 0.85),
    "red x 1.15": (1.0, 1.0, 1.15),
    "red x 1.25": (1.0, 1.0, 1.25),
}
IN_VIEW = (1.4, 3.1)  # [s] at which an instrument is in view, at level 3 of `probe`
LEAST_INSTRUMENT = 0.005  # of the picture, from which an instrument is in view
FPS = 10.0


@dataclass(frozen=True)
class Verdict:
    """Of one image: whether points were chosen, whether across the true gap, how many on an instrument."""

    called: bool
    found: bool
    on_instrument: int
    reason: str


def main(argv: Sequence[str] | None = None) -> int:
    """Print a row for each cast."""
    parser = argparse.ArgumentParser(prog="bench_casts", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, nargs="+", default=[6001, 6002, 6003, 6004])
    parser.add_argument("--level", type=int, nargs="+", default=[1])
    parser.add_argument("--appearance", choices=["plain", "real"], default="plain")
    parser.add_argument("--instruments", action="store_true", help="while an instrument is in view")
    parser.add_argument("--cast", nargs="+", choices=list(CASTS), default=list(CASTS))
    parser.add_argument("--keep", type=Path, help="folder in which rendered images are kept")
    parser.add_argument("--why", action="store_true", help="print why each gap is not found")
    asked = parser.parse_args(argv)
    casts = dict.fromkeys(["as rendered", *asked.cast])
    verdicts: dict[str, dict[bool, list[Verdict]]] = {cast: {True: [], False: []} for cast in casts}
    for is_open in (True, False):
        for name, frame, camera in joints(asked, is_open=is_open):
            for cast in casts:
                verdict = judged(frame, camera, CASTS[cast])
                verdicts[cast][is_open].append(verdict)
                if asked.why and verdict.called != is_open:
                    print(f"{name} {cast}: {verdict.reason or 'called a gap'}", flush=True)
    print(table(verdicts))
    return 0


def joints(asked: argparse.Namespace, *, is_open: bool) -> Iterator[tuple[str, SimulatorFrame, Camera]]:
    """One image of each joint, with its name and camera."""
    jobs = [(level, seed) for level in asked.level for seed in asked.seed]
    directions = list(TravelDirection)
    for level, seed in tqdm(jobs, desc="open" if is_open else "closed", disable=not sys.stderr.isatty()):
        try:
            simulator = KneeSimulator(
                level,
                seed,
                directions[seed % len(directions)],
                gap=FROM_SEED if is_open else None,
                fps=FPS,
                difficulty={"probe": 3} if asked.instruments else None,
                appearance=asked.appearance,
            )
        except SimulationError as error:
            print(f"bench_casts: seed {seed} left out: {error}", file=sys.stderr)
            continue
        lens = simulator.lens
        camera = FisheyeCamera(
            lens.width_px, lens.height_px, lens.focal_px, lens.focal_px, lens.centre_x_px, lens.centre_y_px
        )
        frame = one_frame(simulator, asked)
        if frame is not None:
            yield f"level {level} seed {seed} {'open' if is_open else 'closed'}", frame, camera


def one_frame(simulator: KneeSimulator, asked: argparse.Namespace) -> SimulatorFrame | None:
    """An image from anywhere in the travel; None if an instrument is asked for and none is in view."""
    count, seed = simulator.frame_count, simulator.settings.seed
    index = int(count * (seed * GOLDEN % 1.0))
    if asked.instruments:
        index = round(IN_VIEW[seed % len(IN_VIEW)] * FPS)
    frame = next(iter(frames_of(simulator, asked.keep, index, count)))
    if asked.instruments and frame.instrument_mask.mean() < LEAST_INSTRUMENT:
        return None
    return frame


def judged(frame: SimulatorFrame, camera: Camera, gains: tuple[float, float, float]) -> Verdict:
    """Decide on an image whose channels are multiplied."""
    tracker = GapEdgeTracker()
    edges = tracker.process(0, tinted(frame.image, gains), camera)
    if edges.status is not EdgeStatus.VALID:
        return Verdict(False, False, 0, tracker.reason)
    column, row = np.rint(edges.pixels).astype(int).T
    middle_column, middle_row = np.rint(edges.pixels.mean(axis=0)).astype(int)
    return Verdict(
        True,
        bool(frame.gap_mask[middle_row, middle_column]),
        int(frame.instrument_mask[row, column].sum()),
        "",
    )


def tinted(image: Image, gains: tuple[float, float, float]) -> Image:
    """An image (h, w, 3) with its channels multiplied and clipped."""
    bright: Image = np.rint(image * np.array(gains)).clip(0, 255).astype(np.uint8)
    return bright


def table(verdicts: dict[str, dict[bool, list[Verdict]]]) -> str:
    """Rows of a Markdown table."""
    lines = [
        "| cast | open: gap found | lost by the cast | points elsewhere | closed: called a gap "
        "| points on instruments |",
        "|---|---|---|---|---|---|",
    ]
    reference = verdicts["as rendered"][True]
    for cast, both in verdicts.items():
        opened, closed = both[True], both[False]
        lost = sum(one.found and not other.found for one, other in zip(reference, opened, strict=True))
        lines.append(
            f"| {cast} | {sum(v.found for v in opened)} of {len(opened)} | "
            f"{lost} of {sum(v.found for v in reference)} | "
            f"{sum(v.called and not v.found for v in opened)} | "
            f"{sum(v.called for v in closed)} of {len(closed)} | "
            f"{sum(v.on_instrument for v in (*opened, *closed))} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
