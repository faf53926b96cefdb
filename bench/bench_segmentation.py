"""Segmentation and the decision for a gap, on simulated knees and on real frames that show no gap.

Dice is taken inside the field disc, mean and 10th percentile over frames, for every strategy at the working
size and, to show what that costs, at full size. A false gap is a frame of a closed joint, or a real frame
without a cleft, in which points were chosen. The reliability table lists the sections found in open and in
closed joints, weighted alike, how many are gaps at each confidence.

`--decision` leaves Dice out: many joints, open and closed, each with one direction of travel in turn and
mostly with one image, as images of the same joint are wrong together. The interval is that of Clopper and
Pearson (1934) at 95 %, over joints: a joint counts as wrong by the share of its images that are.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from kept_frames import frames_of
from scipy.stats import beta
from tqdm import tqdm

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.segmentation.choice import WITHOUT_NETWORK
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import FROM_SEED, KneeSimulator, SimulatorFrame
from knee_gap_simulation.scope.hand_motion import TravelDirection

NEEDED = (0.97, 0.96, 0.94, 0.88)
BINS = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
GOLDEN = 0.618034  # [-] the multiples of which spread evenly
SHADES = ((1.0, 0.0), (0.5, 0.0), (0.5, 0.7), (0.25, 0.7))  # gain, and how much of it is lost at the rim


class Judged(NamedTuple):
    """What was decided of a frame: the confidence of the best section (NaN without one), and two truths."""

    confidence: float
    is_gap: bool
    found: bool


def main(argv: Sequence[str] | None = None) -> int:
    """Score the levels, directions, seeds and strategies asked for."""
    parser = argparse.ArgumentParser(prog="bench_segmentation", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, nargs="+", default=[301, 302, 303])
    parser.add_argument("--level", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--travel-direction", nargs="+", default=["along"])
    parser.add_argument("--frames", type=int, default=3, help="of every seed, over its travel")
    parser.add_argument(
        "--strategy", nargs="+", choices=WITHOUT_NETWORK, default=["otsu", "otsu3", "watershed"]
    )
    parser.add_argument("--full-size", action="store_true", help="the first strategy at full size as well")
    parser.add_argument("--no-gap", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="real frames: folders or videos")
    parser.add_argument("--keep", type=Path, help="folder in which rendered images are kept")
    parser.add_argument(
        "--decision",
        nargs="+",
        choices=("open", "closed"),
        help="no Dice, only decisions, on such joints",
    )
    parser.add_argument(
        "--decided-by", choices=WITHOUT_NETWORK, help="strategy of --decision; else the default"
    )
    parser.add_argument(
        "--at", type=float, help="share of the travel at which they are looked at; else each seed has its own"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of wrong decisions")
    asked = parser.parse_args(argv)
    if asked.at is not None and not 0.0 <= asked.at < 1.0:
        parser.error(f"--at must lie in [0, 1), not {asked.at:g}")
    judged = decisions(asked) if asked.decision else scores_and_decisions(asked)
    for path in asked.real:
        frames = [judge_real(picture) for picture in pictures(path)]
        print(f"{path.name}: gap called in {share(frames):.1%} of {len(frames)} frames")
    print_reliability(judged)
    return 0


def decisions(asked: argparse.Namespace) -> list[Judged]:
    """Decide on every joint, report how often it was wrong, and keep the pictures."""
    judged: list[Judged] = []
    directions = list(TravelDirection)
    for level in asked.level:
        for kind in asked.decision:
            joints = []
            for seed in tqdm(asked.seed, desc=f"level {level}, {kind}", disable=not sys.stderr.isatty()):
                direction = directions[seed % len(directions)]
                frames = []
                for frame, camera in rendered_one(level, seed, direction, asked, is_open=kind == "open"):
                    frames.append(judge(frame, camera, asked.decided_by))
                    if asked.pictures and frames[-1].found != (kind == "open"):
                        keep_picture(asked.pictures, f"{kind}_{level}_{seed}_{frame.index}", frame, camera)
                joints += [frames] if frames else []
            images = sum(map(len, joints))
            wrong = float(np.sum([np.mean([f.found for f in frames]) for frames in joints]))
            low, high = interval(wrong, len(joints))
            print(
                f"level {level}  gap called in {wrong / max(len(joints), 1):.1%} ({low:.1%} to {high:.1%}) "
                f"of {images} images of {len(joints)} {kind} joints",
                flush=True,
            )
            judged += [frame for frames in joints for frame in frames]
    return judged


def interval(count: float, of: int) -> tuple[float, float]:
    """Interval of Clopper and Pearson for a share, at 95 %."""
    low = float(beta.ppf(0.025, count, of - count + 1)) if count > 0 else 0.0
    high = float(beta.ppf(0.975, count + 1, of - count)) if count < of else 1.0
    return low, high


def keep_picture(folder: Path, name: str, frame: SimulatorFrame, camera: Camera) -> None:
    """The picture of a wrong decision, by itself and with the mask's outline and the confidence."""
    detector = GapEdgeTracker()
    detector.process(0, frame.image, camera)
    drawn = frame.image.copy()
    outlines, _ = cv2.findContours(detector.gap_mask(), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, (0, 255, 0), 1)
    words = detector.reason or f"confidence {detector.confidence:.2f}"
    cv2.putText(drawn, words, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 1, cv2.LINE_AA)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / f"{name}.png"), np.hstack([frame.image, drawn]))


def scores_and_decisions(asked: argparse.Namespace) -> list[Judged]:
    """Dice of every strategy, and the decision on the same frames."""
    judged: list[Judged] = []
    for level in asked.level:
        scores: dict[str, list[float]] = defaultdict(list)
        opened: list[Judged] = []
        for frame, camera in rendered(level, asked, is_open=True):
            for name in asked.strategy:
                scores[name].append(dice_of(frame, camera, EdgeParameters(segmentation=name)))
            if asked.full_size:
                full = EdgeParameters(segmentation=asked.strategy[0], working_rows=720)
                scores[f"{asked.strategy[0]} at 720 rows"].append(dice_of(frame, camera, full))
            opened.append(judge(frame, camera))
        for name, values in scores.items():
            print(
                f"level {level}  {name:20s} Dice {np.mean(values):.4f}  p10 {np.percentile(values, 10):.3f}  "
                f"worst {min(values):.3f}  needed {NEEDED[level]:.2f}  {len(values)} frames",
                flush=True,
            )
        print(f"level {level}  gap found in {share(opened):.1%} of {len(opened)} frames with one", flush=True)
        judged += opened
        if asked.no_gap:
            closed = [judge(frame, camera) for frame, camera in rendered(level, asked, is_open=False)]
            print(
                f"level {level}  false gap in {share(closed):.1%} of {len(closed)} closed joints", flush=True
            )
            judged += closed
    return judged


def rendered(
    level: int, asked: argparse.Namespace, *, is_open: bool
) -> Iterator[tuple[SimulatorFrame, Camera]]:
    """Frames of every seed and direction, spread over the travel."""
    jobs = [(direction, seed) for direction in asked.travel_direction for seed in asked.seed]
    for direction, seed in tqdm(jobs, desc=f"level {level}", disable=not sys.stderr.isatty()):
        yield from rendered_one(level, seed, direction, asked, is_open=is_open)


def rendered_one(
    level: int, seed: int, direction: str, asked: argparse.Namespace, *, is_open: bool
) -> Iterator[tuple[SimulatorFrame, Camera]]:
    """Frames of one joint, spread over the travel; none, with a message, if the travel does not fit."""
    try:
        simulator = KneeSimulator(level, seed, direction, gap=FROM_SEED if is_open else None)
    except SimulationError as error:
        print(f"bench_segmentation: seed {seed} {direction} left out: {error}", file=sys.stderr)
        return
    lens = simulator.lens
    camera = FisheyeCamera(
        lens.width_px, lens.height_px, lens.focal_px, lens.focal_px, lens.centre_x_px, lens.centre_y_px
    )
    step = max(1, simulator.frame_count // asked.frames)
    # Where the lens begins its travel a joint looks other than in the middle: every seed has its own places.
    place = asked.at if asked.at is not None else seed * GOLDEN % 1.0
    start = int(step * (place if asked.decision else 0.5))
    for frame in frames_of(simulator, asked.keep, start, step):
        yield frame, camera


def dice_of(frame: SimulatorFrame, camera: Camera, parameters: EdgeParameters) -> float:
    """Dice of a frame's mask."""
    detector = GapEdgeTracker(parameters)
    detector.process(0, frame.image, camera)
    mask, truth = detector.gap_mask() > 0, frame.gap_mask
    return float(2 * (mask & truth).sum() / max(mask.sum() + truth.sum(), 1))


def judge(frame: SimulatorFrame, camera: Camera, strategy: str | None = None) -> Judged:
    """Decide on a frame by itself, by a strategy or the default one, and compare with its truth."""
    parameters = EdgeParameters() if strategy is None else EdgeParameters(segmentation=strategy)
    confidence, found = decide(frame.image, camera, parameters)
    detector = GapEdgeTracker(replace(parameters, minimum_confidence=0.0))
    edges = detector.process(0, frame.image, camera)
    middle = np.rint(edges.pixels.mean(axis=0)) if edges.status is EdgeStatus.VALID else None
    is_gap = middle is not None and bool(frame.gap_mask[int(middle[1]), int(middle[0])])
    return Judged(confidence, is_gap, found)


def decide(image: Image, camera: Camera, parameters: EdgeParameters | None = None) -> tuple[float, bool]:
    """Confidence of the best section of a picture, and whether points were chosen."""
    detector = GapEdgeTracker(parameters)
    edges = detector.process(0, image, camera)
    return detector.confidence, edges.status is EdgeStatus.VALID


def judge_real(image: Image) -> Judged:
    """Decide on a real frame without a cleft."""
    height, width = image.shape[:2]
    camera = FisheyeCamera(width, height, 0.6 * height, 0.6 * height, width / 2, height / 2)
    confidence, found = decide(image, camera)
    return Judged(confidence, False, found)


def pictures(path: Path) -> Iterator[Image]:
    """Every fifth frame of a video, or a folder of pictures, each as it is and under less and less light."""
    frames: list[Image] = []
    if path.is_dir():
        frames = [np.asarray(cv2.imread(str(file)), np.uint8) for file in sorted(path.glob("*.jpg"))]
    else:
        video = cv2.VideoCapture(str(path))
        while (read := video.read())[0]:
            frames.append(np.asarray(read[1], np.uint8))
        frames = frames[::5]
    for frame in frames:
        rows, columns = np.ogrid[-1 : 1 : frame.shape[0] * 1j, -1 : 1 : frame.shape[1] * 1j]
        away = np.minimum(np.hypot(rows, columns), 1.0)[..., None]
        for gain, fall in SHADES:
            yield np.asarray(frame * gain * (1.0 - fall * away**2), np.uint8)


def share(frames: Sequence[Judged]) -> float:
    """Share of frames in which points were chosen."""
    return float(np.mean([frame.found for frame in frames])) if frames else float("nan")


def print_reliability(judged: Sequence[Judged]) -> None:
    """Confidence against the share of true gaps among the sections that have it, open and closed alike."""
    known = [frame for frame in judged if np.isfinite(frame.confidence)]
    gaps, others = sum(frame.is_gap for frame in known), sum(not frame.is_gap for frame in known)
    if not gaps or not others:
        return
    print("confidence    sections   gaps among them (gaps and others weighted alike)")
    for low, high in pairwise(BINS):
        inside = [f for f in known if low <= f.confidence < high or (high == 1.0 and f.confidence == 1.0)]
        right = sum(frame.is_gap for frame in inside) / gaps
        wrong = sum(not frame.is_gap for frame in inside) / others
        words = f"{right / (right + wrong):.2f}" if inside else "-"
        print(f"{low:.1f} to {high:.1f}   {len(inside):8d}   {words:>5s}")


if __name__ == "__main__":
    sys.exit(main())
