"""Cost of following the notch in an image, and the error of the scope's rotation from it.

    tools/env python bench/bench_notch.py --first 2001 --seeds 4

Pictures of a board by a scope that is turned within two seconds to either side, of known truth. The cost of
one core stands beside a floor of the same run: decoding the JPEG, and shrinking the picture to a quarter.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from time import process_time
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image
from knee_gap_perception.calibrate.observations import wrapped
from knee_gap_perception.image.field_of_view import find_field_of_view
from knee_gap_perception.scope_rotation.notch import common_shape, find_notch
from knee_gap_perception.scope_rotation.notch_tracker import NotchFollower
from knee_gap_simulation.calibration.bag import CalibrationMotion, CalibrationRecording, calibration_truth
from knee_gap_simulation.calibration.scene import BoardCamera
from knee_gap_simulation.scope.imaging import jpeg

PERIOD_NS = 33_333_333
FOR_SHAPE = 8  # images from which the notch's shape is measured, as a calibration does


def turned_pictures(seed: int, seconds: float) -> tuple[list[Image], npt.NDArray[np.float64]]:
    """Pictures at 30 a second, and the true angle of the notch in each [rad]."""
    recording = CalibrationRecording(seed=seed, oblique_s=seconds)
    truth = calibration_truth(recording)
    motion, camera = (
        CalibrationMotion(recording, truth),
        BoardCamera(truth.board, truth.lens, truth.scope, seed),
    )
    times = recording.board_s + np.arange(0.0, seconds, 1e-9 * PERIOD_NS)
    images = [np.asarray(camera.frame(motion.lens_on_board(t), motion.turn(t)), np.uint8) for t in times]
    # The notch goes round with the scope.
    return images, np.array([truth.scope.notch_angle + motion.turn(t) for t in times])


def milliseconds(work: Callable[[Any], object], items: Iterable[Any], rounds: int) -> float:
    """Median over rounds of the mean time of one core an item."""
    known, spent = list(items), []
    for _ in range(rounds):
        start = process_time()
        for item in known:
            work(item)
        spent.append((process_time() - start) / len(known))
    return 1e3 * float(np.median(spent))


def main(argv: Sequence[str] | None = None) -> int:
    """Print cost and errors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=2.0, help="time in which the scope is turned")
    parser.add_argument("--rounds", type=int, default=8, help="times the last seed's pictures are timed")
    asked = parser.parse_args(argv)
    cv2.setNumThreads(1)
    errors, shown = [], 0
    for seed in range(asked.first, asked.first + asked.seeds):
        images, angles = turned_pictures(seed, asked.seconds)
        fields = [find_field_of_view(image) for image in images[:FOR_SHAPE]]
        shape = common_shape(
            [find_notch(i, f) for i, f in zip(images[:FOR_SHAPE], fields, strict=True) if f is not None]
        )
        if shape is None:
            print(f"seed {seed}: no notch in the first {FOR_SHAPE} images")
            return 1
        follower = NotchFollower(shape)
        observations = [follower.look((k + 1) * PERIOD_NS, image) for k, image in enumerate(images)]
        off = [s.angle - angle for s, angle in zip(observations, angles, strict=True) if s.seen]
        errors.append(np.degrees(wrapped(np.array(off))))
        shown += len(images)
    off_deg = np.concatenate(errors)
    print(
        f"seen in {len(off_deg)} of {shown} images, {np.sqrt(np.mean(off_deg**2)):.3f} deg RMS, "
        f"at worst {np.abs(off_deg).max():.3f}"
    )
    stamps = iter(range(PERIOD_NS, 10**15, PERIOD_NS))
    packed = [np.frombuffer(jpeg(image, 90), np.uint8) for image in images]
    costs = {
        "notch": milliseconds(lambda image: follower.look(next(stamps), image), images, asked.rounds),
        "decoding alone": milliseconds(
            lambda data: cv2.imdecode(data, cv2.IMREAD_COLOR), packed, asked.rounds
        ),
        "shrinking alone": milliseconds(
            lambda image: cv2.resize(image, (320, 180), interpolation=cv2.INTER_AREA), images, asked.rounds
        ),
    }
    print(", ".join(f"{name} {cost:.2f} ms" for name, cost in costs.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
