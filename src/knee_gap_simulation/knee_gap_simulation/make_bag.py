"""`make_bag`: a bag of a scene whose gap is known."""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_replay.errors import BagError
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.imaging import Sensor, jpeg
from knee_gap_simulation.lens import Lens
from knee_gap_simulation.motion import HandMotion
from knee_gap_simulation.recording import PARAMETERS_FILE, Sample, write_parameters, write_recording
from knee_gap_simulation.render import ScopeCamera
from knee_gap_simulation.rigid import FloatArray, inverse, transform
from knee_gap_simulation.rims import RimScene
from knee_gap_simulation.scope import Scope
from knee_gap_simulation.tracker import TrackerNoise, tracked_body
from knee_gap_simulation.truth import SceneTruth

EPOCH_NS = 1_700_000_000_000_000_000
TRACKER_HZ = 120.0
POSE_MARGIN_S = 0.05
# The tracker's clock is not the camera's: its samples fall between the images.
TRACKER_PHASE_S = 0.0017


@dataclass(frozen=True)
class Recording:
    """What to record. Lengths [m], times [s]."""

    gap: float = 0.004
    travel: float = 0.008
    depth: float = 0.010
    seed: int = 7
    duration_s: float = 6.0
    fps: float = 60.0
    quality: int = 60

    def __post_init__(self) -> None:
        if not 0.1 <= self.duration_s <= 600.0:
            raise SimulationError(f"the duration must lie in [0.1, 600] s, not {self.duration_s:g} s")
        if not 1.0 <= self.fps <= 240.0:
            raise SimulationError(f"fps must lie in [1, 240] frames a second, not {self.fps:g}")
        if not 1 <= self.quality <= 100:
            raise SimulationError(f"the JPEG quality must lie in [1, 100], not {self.quality}")
        if self.seed < 0:
            raise SimulationError(f"the seed must not be negative, but is {self.seed}")


def world_from_scene(seed: int) -> FloatArray:
    """``T_world_scene`` (4, 4): a knee somewhere in the tracker's volume, turned anyhow."""
    rng = np.random.default_rng([seed, 0x574F])
    return transform(rng.uniform(-1.2, 1.2, 3), rng.uniform([-0.5, 0.8, -0.5], [0.5, 1.2, 0.5]))


def image_times(recording: Recording) -> FloatArray:
    """Exposure times (n,) [s] of the images."""
    return np.arange(round(recording.duration_s * recording.fps)) / recording.fps


def tracker_times(recording: Recording) -> FloatArray:
    """Times (n,) [s] of the tracker: from 50 ms before the first image to 50 ms after the last."""
    last = image_times(recording)[-1] + POSE_MARGIN_S
    return np.arange(-POSE_MARGIN_S + TRACKER_PHASE_S, last, 1.0 / TRACKER_HZ)


def hand_motion(recording: Recording) -> HandMotion:
    """How the lens moves in the scene."""
    return HandMotion(travel=recording.travel, depth=recording.depth, seed=recording.seed)


def samples(
    recording: Recording, truth: SceneTruth, motion: HandMotion, *, progress: bool = True
) -> Iterator[Sample]:
    """Everything that is recorded, in the order in which it would arrive."""
    yield from merge(
        _pose_samples(recording, truth, motion),
        _image_samples(recording, truth, motion, progress=progress),
        key=lambda sample: sample.record_ns,
    )


def _pose_samples(recording: Recording, truth: SceneTruth, motion: HandMotion) -> Iterator[Sample]:
    times = tracker_times(recording)
    T_world_lens = truth.T_world_scene @ motion.poses(np.maximum(times, 0.0))
    T_body_lens = truth.scope.body_to_lens()
    rng = np.random.default_rng([recording.seed, 0x5452])
    reported = tracked_body(T_world_lens, T_body_lens, TrackerNoise(), rng)
    true = T_world_lens @ inverse(T_body_lens)
    for time, body, body_true in zip(times, reported, true, strict=True):
        yield Sample(_stamp_ns(time), T_world_body=body, T_world_body_true=body_true)


def _image_samples(
    recording: Recording, truth: SceneTruth, motion: HandMotion, *, progress: bool
) -> Iterator[Sample]:
    sensor = Sensor(shot_noise=0.003, read_noise=0.0006)
    camera = ScopeCamera(truth.scene, truth.lens, sensor=sensor, seed=recording.seed)
    times = image_times(recording)
    for time in _told(times, progress=progress):
        T_scene_lens = motion.poses(time)
        image = camera.frame(T_scene_lens, 1.0 / recording.fps)
        yield Sample(
            _stamp_ns(time),
            jpeg=jpeg(image, recording.quality),
            T_world_lens=truth.T_world_scene @ T_scene_lens,
        )


def _told(times: FloatArray, *, progress: bool) -> Iterable[float]:
    """The times, with a progress bar on a terminal and a line every 60 images elsewhere."""
    if sys.stderr.isatty():
        return tqdm(times, desc="rendering", unit="image", disable=not progress)
    return _told_in_lines(times) if progress else times


def _told_in_lines(times: FloatArray) -> Iterator[float]:
    for index, time in enumerate(times):
        if index % 60 == 0:
            print(f"rendering: image {index} of {len(times)}", file=sys.stderr)
        yield time


def _stamp_ns(time_s: float) -> int:
    return EPOCH_NS + round(time_s * 1e9)


def make_bag(path: Path, recording: Recording, *, progress: bool = True) -> SceneTruth:
    """Render a recording into a new bag at ``path`` and return its truth.

    Beside the data the folder gets ``scope.yaml``, the parameters of the tracking node. Raises
    SimulationError for a recording that cannot be made and BagError where the bag cannot be written.
    """
    scene = RimScene.random(recording.gap, recording.seed)
    motion = hand_motion(recording)
    truth = SceneTruth(scene, world_from_scene(recording.seed), Lens(), Scope())
    metadata = truth.as_metadata(recording=vars(recording))
    write_recording(path, samples(recording, truth, motion, progress=progress), truth.lens, metadata)
    write_parameters(path / PARAMETERS_FILE, truth.scope)
    return truth


def _parser() -> argparse.ArgumentParser:
    defaults = Recording()
    parser = argparse.ArgumentParser(
        prog="make_bag",
        description="Make a bag of a scene whose gap is known, seen by a tracked arthroscope.",
    )
    parser.add_argument("out", type=Path, help="folder of the new bag")
    parser.add_argument("--gap-mm", type=float, default=1e3 * defaults.gap, help="distance of the rims")
    parser.add_argument("--travel-mm", type=float, default=1e3 * defaults.travel, help="travel of the scope")
    parser.add_argument(
        "--depth-mm", type=float, default=1e3 * defaults.depth, help="from the lens to the gap"
    )
    parser.add_argument("--seed", type=int, default=defaults.seed, help="the same seed gives the same bag")
    parser.add_argument(
        "--duration-s", type=float, default=defaults.duration_s, help="length of the recording"
    )
    parser.add_argument("--fps", type=float, default=defaults.fps, help="images a second")
    parser.add_argument("--quality", type=int, default=defaults.quality, help="of the JPEG images, 1-100")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Make a bag; 0 when it is made."""
    arguments = _parser().parse_args(argv)
    try:
        recording = Recording(
            gap=1e-3 * arguments.gap_mm,
            travel=1e-3 * arguments.travel_mm,
            depth=1e-3 * arguments.depth_mm,
            seed=arguments.seed,
            duration_s=arguments.duration_s,
            fps=arguments.fps,
            quality=arguments.quality,
        )
        make_bag(arguments.out, recording)
    except (SimulationError, BagError) as error:
        print(f"make_bag: {error}", file=sys.stderr)
        return 1
    size = sum(file.stat().st_size for file in arguments.out.iterdir()) / 1e6
    print(f"{arguments.out}: {recording.duration_s:g} s, {size:.1f} MB")
    return 0
