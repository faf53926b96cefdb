"""The command `make_bag`: a simulated bag of a scene of known gap."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from knee_gap_core.bag.errors import BagError
from knee_gap_core.user_files import flaw_of_new
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.errors import KneeGapError
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.calibration.bag import (
    CalibrationRecording,
    calibration_truth,
    make_calibration_bag,
)
from knee_gap_simulation.calibration.scene import RotatedScope
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee_simulator import FROM_SEED, Anatomy, KneeSimulator
from knee_gap_simulation.looks.look import Appearance
from knee_gap_simulation.make_bag.arguments import bag_parser
from knee_gap_simulation.recordings.recording import (
    PARAMETERS_FILE,
    Sample,
    pose_samples,
    write_parameters,
    write_recording,
)
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_simulation.rims.render import ScopeCamera
from knee_gap_simulation.rims.scene import RimScene
from knee_gap_simulation.scope.clocks import image_times, stamp_ns, tracker_times
from knee_gap_simulation.scope.hand_motion import HandMotion, TravelDirection
from knee_gap_simulation.scope.imaging import Sensor, jpeg
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import Media, Medium, RefractedLens
from knee_gap_simulation.scope.tracker import track_lens, world_from_scene

TURN_BEGIN_S = 0.5
TURN_PERIOD_S = 4.0  # of one rotation to and fro


@dataclass(frozen=True)
class Recording:
    """Settings of a recording of the simple scene of two rims. Lengths [m], times [s].

    `scope_of` is the seed of a calibration recording, whose scope and lens are used; without it they are the
    nominal ones. `video_delay` is the delay of the images' stamps. `turn` [rad] is the amplitude of the
    rotation of that scope in its camera head, to which the tracked body is fixed; its notch is then visible.
    The rims lie in `medium` (saline). The lens was calibrated in `calibrated_in`: by default the same medium,
    but air for the scope of a calibration recording. `portal` is the distance from the tip back to the pivot
    of the scope, as in `HandMotion`.
    """

    gap: float = 0.004
    travel: float = 0.008
    depth: float = 0.010
    seed: int = 7
    duration_s: float = 6.0
    fps: float = 60.0
    quality: int = 60
    scope_of: int | None = None
    video_delay: float = 0.0
    turn: float | None = None
    medium: Medium | None = None
    calibrated_in: Medium | None = None
    portal: float | None = None

    @property
    def media(self) -> Media:
        """Media in which the lens was calibrated and is used."""
        used_in: Medium = "saline" if self.medium is None else self.medium
        calibrated_in = used_in if self.scope_of is None else "air"
        return Media(calibrated_in if self.calibrated_in is None else self.calibrated_in, used_in)

    def as_dict(self) -> dict[str, Any]:
        """Settings as plain values for JSON; media and portal only if they were given."""
        optional = ("medium", "calibrated_in", "portal")
        return {
            name: value for name, value in vars(self).items() if name not in optional or value is not None
        }

    def __post_init__(self) -> None:
        if not 0.1 <= self.duration_s <= 600.0:
            raise SimulationError(f"the duration must lie in [0.1, 600] s, not {self.duration_s:g} s")
        if not 1.0 <= self.fps <= 240.0:
            raise SimulationError(f"fps must lie in [1, 240] frames a second, not {self.fps:g}")
        if not 1 <= self.quality <= 100:
            raise SimulationError(f"the JPEG quality must lie in [1, 100], not {self.quality}")
        for seed in (self.seed, self.scope_of or 0):
            if seed < 0:
                raise SimulationError(f"the seed must not be negative, but is {seed}")
        if not abs(self.video_delay) <= 0.2:
            raise SimulationError(f"the video's delay must lie in [-0.2, 0.2] s, not {self.video_delay:g} s")
        if self.turn is not None and self.scope_of is None:
            raise SimulationError("only the scope of a calibration bag can rotate: add --scope-of")

    def turn_at(self, time: npt.ArrayLike) -> Array:
        """Rotation [rad] of the scope in its camera head at times (...) [s]."""
        since = np.maximum(np.asarray(time, dtype=np.float64) - TURN_BEGIN_S, 0.0)
        return np.asarray((self.turn or 0.0) * 0.5 * (1.0 - np.cos(2.0 * np.pi * since / TURN_PERIOD_S)))


class _View:
    """Pose of the lens in the scene and direction of its notch in the image, over time [s]."""

    def __init__(self, recording: Recording, motion: HandMotion, scope: RotatedScope) -> None:
        self._recording, self._motion, self._scope = recording, motion, scope
        self._T_lens_body = inverse(scope.body_to_lens(0.0))

    def lens(self, time: float) -> Array:
        """``T_scene_lens`` (4, 4): the hand moves the camera head, in which the scope rotates."""
        straight = self._motion.poses(time)
        if self._recording.turn is None:
            return straight
        turn = float(self._recording.turn_at(time))
        return np.asarray(straight @ self._T_lens_body @ self._scope.body_to_lens(turn))

    def notch(self, time: float) -> float | None:
        """Angle of the notch [rad]; None for a scope without a visible notch."""
        if self._recording.turn is None:
            return None
        return self._scope.notch_angle + float(self._recording.turn_at(time))


def make_bag(path: Path, recording: Recording, *, progress: bool = True) -> SceneTruth:
    """Render a recording of the simple scene into a new bag at ``path``; return its ground truth.

    The folder also gets ``scope.yaml``, the parameters of segmentation_node and tracking_node. Raises
    SimulationError for settings that cannot be simulated and BagError if the bag cannot be written.
    """
    scene = RimScene.random(recording.gap, recording.seed)
    lens, turned = Lens(), RotatedScope()
    if recording.scope_of is not None:
        of_scope = calibration_truth(CalibrationRecording(seed=recording.scope_of))
        lens, turned = of_scope.lens, of_scope.scope
    lens = RefractedLens.of(lens, recording.media.ratio)
    motion = HandMotion(
        travel=recording.travel,
        depth=recording.depth,
        seed=recording.seed,
        portal=recording.portal,
        shaft=turned.scope.shaft_in_lens(),
    )
    truth = SceneTruth(scene, world_from_scene(recording.seed), lens, turned.scope, media=recording.media)
    times = tracker_times(recording.duration_s, recording.fps)
    view = _View(recording, motion, turned)
    lenses = truth.T_world_scene @ np.array([view.lens(time) for time in times.clip(0.0)])
    on_body = np.array([turned.body_to_lens(float(turn)) for turn in recording.turn_at(times)])
    bodies = track_lens(lenses, on_body, recording.seed)
    _write(
        path,
        truth,
        merge(
            pose_samples(times, bodies, lenses, on_body),
            _rim_images(recording, truth, view, progress=progress),
            key=lambda sample: sample.record_ns,
        ),
        recording=recording.as_dict(),
    )
    return truth


def make_knee_bag(path: Path, simulator: KneeSimulator, *, progress: bool = True) -> SceneTruth:
    """Render a knee simulation into a new bag at ``path``, as `make_bag` does; return its ground truth."""
    truth = SceneTruth(
        simulator.scene,
        simulator.T_world_scene,
        simulator.lens,
        simulator.scope,
        simulator.probe,
        simulator.settings.media,
    )
    times, bodies, lenses = simulator.tracked_body_poses()
    _write(
        path,
        truth,
        merge(
            pose_samples(times, bodies, lenses, simulator.scope.body_to_lens()),
            _knee_images(simulator, progress=progress),
            key=lambda sample: sample.record_ns,
        ),
        simulator=simulator.settings.as_dict(),
    )
    return truth


def _write(path: Path, truth: SceneTruth, samples: Iterator[Sample], **settings: Any) -> None:
    write_recording(path, samples, truth.lens, truth.as_metadata(**settings))
    write_parameters(path / PARAMETERS_FILE, truth.scope, truth.media)


def _rim_images(recording: Recording, truth: SceneTruth, view: _View, *, progress: bool) -> Iterator[Sample]:
    sensor = Sensor(shot_noise=0.003, read_noise=0.0006)
    assert isinstance(truth.scene, RimScene)
    camera = ScopeCamera(truth.scene, truth.lens, sensor=sensor, seed=recording.seed)
    times = image_times(recording.duration_s, recording.fps)
    with _Progress(len(times), progress=progress) as progress_line:
        for time in times:
            T_scene_lens = view.lens(time)
            image = camera.frame(T_scene_lens, 1.0 / recording.fps, view.notch(time))
            progress_line.one_more()
            yield Sample(
                stamp_ns(time + recording.video_delay),
                jpeg=jpeg(image, recording.quality),
                T_world_lens=truth.T_world_scene @ T_scene_lens,
            )


def _knee_images(simulator: KneeSimulator, *, progress: bool) -> Iterator[Sample]:
    with _Progress(simulator.frame_count, progress=progress) as progress_line:
        for frame in simulator.frames():
            progress_line.one_more()
            yield Sample(frame.stamp_ns, jpeg=frame.jpeg, T_world_lens=frame.T_world_lens)


class _Progress:
    """Progress of rendering: a bar on a terminal, else a line every 60 images."""

    def __init__(self, count: int, *, progress: bool) -> None:
        self._count, self._done, self._lines = count, 0, progress and not sys.stderr.isatty()
        hidden = not progress or self._lines
        self._bar = tqdm(total=count, desc="rendering", unit="image", disable=hidden)

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def one_more(self) -> None:
        """Count one image."""
        self._bar.update()
        self._done += 1
        if self._lines and (self._done % 60 == 0 or self._done == self._count):
            print(f"rendering: {self._done} of {self._count} images", file=sys.stderr)


def _knee(arguments: argparse.Namespace) -> KneeSimulator:
    if arguments.quality is not None:
        raise SimulationError("--quality is for the rims; a knee's JPEG quality follows its noise level")
    if arguments.no_gap and arguments.gap_mm is not None:
        raise SimulationError("--no-gap and --gap-mm exclude each other")
    defaults = Recording()
    gap = FROM_SEED if arguments.gap_mm is None else 1e-3 * arguments.gap_mm
    return KneeSimulator(
        arguments.level or 0,
        arguments.seed,
        arguments.travel_direction or TravelDirection.ALONG,
        gap=None if arguments.no_gap else gap,
        depth=FROM_SEED if arguments.depth_mm is None else 1e-3 * arguments.depth_mm,
        travel=1e-3 * arguments.travel_mm,
        duration_s=4.0 if arguments.duration_s is None else arguments.duration_s,
        fps=defaults.fps if arguments.fps is None else arguments.fps,
        difficulty=dict(arguments.difficulty),
        medium=arguments.medium or "saline",
        calibrated_in=arguments.calibrated_in,
        portal=_portal(arguments),
        appearance=arguments.appearance or Appearance.PLAIN,
        anatomy=_anatomy(arguments),
    )


def _anatomy(arguments: argparse.Namespace) -> Anatomy | None:
    if arguments.anatomy is None:
        if arguments.mesh_unit or arguments.compartment or arguments.flexion_deg is not None:
            raise SimulationError("--mesh-unit, --compartment and --flexion-deg are for --anatomy")
        return None
    defaults = Anatomy(arguments.anatomy)
    flexion = arguments.flexion_deg
    return Anatomy(
        arguments.anatomy,
        arguments.mesh_unit or defaults.unit,
        arguments.compartment or defaults.compartment,
        defaults.flexion if flexion is None else float(np.radians(flexion)),
    )


def _portal(arguments: argparse.Namespace) -> float | None:
    return None if arguments.portal_mm is None else 1e-3 * arguments.portal_mm


def _rims(arguments: argparse.Namespace) -> Recording:
    defaults = Recording()
    return Recording(
        gap=defaults.gap if arguments.gap_mm is None else 1e-3 * arguments.gap_mm,
        travel=1e-3 * arguments.travel_mm,
        depth=defaults.depth if arguments.depth_mm is None else 1e-3 * arguments.depth_mm,
        seed=arguments.seed,
        duration_s=defaults.duration_s if arguments.duration_s is None else arguments.duration_s,
        fps=defaults.fps if arguments.fps is None else arguments.fps,
        quality=defaults.quality if arguments.quality is None else arguments.quality,
        scope_of=arguments.scope_of,
        video_delay=1e-3 * (arguments.video_delay_ms or 0.0),
        turn=None if arguments.turn_deg is None else float(np.radians(arguments.turn_deg)),
        medium=arguments.medium,
        calibrated_in=arguments.calibrated_in,
        portal=_portal(arguments),
    )


def _calibration(arguments: argparse.Namespace) -> CalibrationRecording:
    others = (
        arguments.level,
        arguments.gap_mm,
        arguments.depth_mm,
        arguments.travel_direction,
        arguments.calibrated_in,
        arguments.portal_mm,
        arguments.appearance,
        arguments.anatomy,
        arguments.mesh_unit,
        arguments.compartment,
        arguments.flexion_deg,
    )
    if arguments.no_gap or arguments.difficulty or any(value is not None for value in others):
        raise SimulationError(
            "--calibration shows a board: a knee, its look, gap, depth and portal do not apply"
        )
    defaults = CalibrationRecording()
    delay_ms = 1e3 * defaults.video_delay if arguments.video_delay_ms is None else arguments.video_delay_ms
    return CalibrationRecording(
        seed=arguments.seed,
        fps=defaults.fps if arguments.fps is None else arguments.fps,
        board_s=defaults.board_s if arguments.duration_s is None else arguments.duration_s,
        video_delay=1e-3 * delay_ms,
        board=arguments.board or defaults.board,
        lens=arguments.lens or defaults.lens,
        medium=arguments.medium or defaults.medium,
        quality=defaults.quality if arguments.quality is None else arguments.quality,
    )


def _printed_times(times: Iterator[float], count: int) -> Iterator[float]:
    with _Progress(count, progress=True) as progress_line:
        for time in times:
            progress_line.one_more()
            yield time


def main(argv: Sequence[str] | None = None) -> int:
    """Make a bag; return 0 if it is written."""
    arguments = bag_parser().parse_args(argv)
    turned = arguments.turn_deg is not None
    of_rims = (
        turned or arguments.scope_of is not None or (arguments.video_delay_ms and not arguments.calibration)
    )
    of_meshes = (arguments.anatomy, arguments.mesh_unit, arguments.compartment, arguments.flexion_deg)
    of_a_knee = (
        arguments.difficulty
        or arguments.no_gap
        or arguments.travel_direction
        or arguments.appearance
        or any(value is not None for value in of_meshes)
    )
    try:
        if (arguments.board or arguments.lens) and not arguments.calibration:
            raise SimulationError("--board and --lens are for --calibration")
        if flaw := flaw_of_new(arguments.out):
            raise BagError(flaw)
        if arguments.calibration:
            make_calibration_bag(arguments.out, _calibration(arguments), _printed_times)
        elif arguments.level is not None or of_a_knee:
            if of_rims:
                raise SimulationError(
                    "--scope-of, --turn-deg and --video-delay-ms are for the rims, not for a knee"
                )
            make_knee_bag(arguments.out, _knee(arguments))
        else:
            make_bag(arguments.out, _rims(arguments))
    except (KneeGapError, OSError) as error:
        print(f"make_bag: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("make_bag: stopped before the end", file=sys.stderr)
        return 130
    size = sum(file.stat().st_size for file in arguments.out.iterdir()) / 1e6
    print(f"{arguments.out}: {size:.1f} MB")
    return 0
