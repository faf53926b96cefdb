"""Cost of an image in segmentation_node's core, beside the floor: decoding the JPEG it came in.

Points are followed with the tracked pose of the lens, as when the tracker runs, and by the images alone.
"""

import argparse
import gc
import sys
from collections.abc import Callable, Sequence
from functools import partial
from time import process_time
from types import SimpleNamespace
from typing import TypeVar

import cv2
import numpy as np
from bench_edges import lens_pose

from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.edge_tracking.overlay import draw_overlay
from knee_gap_perception.edge_tracking.warm_up import warm_up
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.messages import image_from_compressed
from knee_gap_simulation.knee_simulator import KneeSimulator

Result = TypeVar("Result")


def main(argv: Sequence[str] | None = None) -> int:
    """Print the cost of an image in milliseconds of one core, median and 99th percentile."""
    parser = argparse.ArgumentParser(prog="bench_perception", description=__doc__)
    parser.add_argument("--level", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--images", type=int, default=45, help="pictures of the simulated knee, at 60 a second"
    )
    parser.add_argument("--rounds", type=int, default=6, help="times they are gone through, to and fro")
    asked = parser.parse_args(argv)
    cv2.setNumThreads(1)
    warm_up()
    simulator = KneeSimulator(asked.level, asked.seed, duration_s=asked.images / 60.0, fps=60.0)
    frames = list(simulator.frames())
    lens = simulator.lens
    camera = FisheyeCamera(
        lens.width_px, lens.height_px, lens.focal_px, lens.focal_px, lens.centre_x_px, lens.centre_y_px
    )
    order = [frame for turn in range(asked.rounds) for frame in (frames if turn % 2 == 0 else frames[-2::-1])]
    decoding: list[float] = []
    following: dict[str, list[float]] = {}
    starting: list[float] = []
    for guide in ("with poses", "images alone"):
        detector, following[guide], valid = GapEdgeTracker(), [], 0
        for frame in frames[:2]:
            detector.process(frame.index, frame.image, camera)
        detector.end_track()
        # As a node does before its first image.
        gc.collect()
        gc.freeze()
        for index, frame in enumerate(order):
            message = SimpleNamespace(format="jpeg", data=frame.jpeg)
            spent, image = timed(partial(image_from_compressed, message))
            decoding.append(spent)
            pose = lens_pose(frame) if guide == "with poses" else None
            stamp = 16_666_667 * (index + 1)
            spent, edges = timed(partial(detector.process, stamp, image, camera, pose))
            # The first image of a track is searched, and points are chosen in it.
            (following[guide] if index else starting).append(spent)
            valid += edges.status is EdgeStatus.VALID
        print(f"{guide}: {valid} of {len(order)} images valid")
    # As long as no gap is found every image is searched.
    searcher = GapEdgeTracker(EdgeParameters(minimum_confidence=1.0))
    searching = [
        timed(partial(searcher.process, 16_666_667 * index, frame.image, camera))[0]
        for index, frame in enumerate(frames)
    ]
    masking, mask = timed(detector.gap_mask)
    drawing, _ = timed(partial(draw_overlay, order[-1].image, edges, mask, "", camera))
    print(f"{len(order)} images of {lens.width_px}x{lens.height_px}, level {asked.level}, one core")
    print(f"decoding alone       {formatted(decoding)}")
    for guide, seconds in following.items():
        print(f"edges, {guide:13s} {formatted(seconds)}")
    print(f"start of a track     {1e3 * max(starting):5.1f} ms")
    print(f"search, no gap       {formatted(searching)}")
    ratio = percentile(following["with poses"], 50) / percentile(decoding, 50)
    print(f"edges / decoding     {ratio:5.2f}")
    print(f"mask, when asked for {1e3 * masking:5.1f} ms; overlay, when asked for {1e3 * drawing:.1f} ms")
    return 0


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds of the processor that work takes, and what it returns."""
    start = process_time()
    result = work()
    return process_time() - start, result


def formatted(seconds: list[float]) -> str:
    """Median and 99th percentile in milliseconds."""
    return f"p50 {percentile(seconds, 50):5.1f} ms  p99 {percentile(seconds, 99):5.1f} ms"


def percentile(seconds: list[float], share: float) -> float:
    """A percentile of times [s] in milliseconds."""
    return float(1e3 * np.percentile(seconds, share))


if __name__ == "__main__":
    sys.exit(main())
