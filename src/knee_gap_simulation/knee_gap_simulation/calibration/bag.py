"""Simulated calibration recordings with ground truth: board, rotated scope, pivoting.

The three steps are recorded one after the other. A topic marks the start of each, as a laboratory can do with
`ros2 topic pub --once /knee_gap/calibration_step std_msgs/msg/String "data: board"`.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from knee_gap_core.bag.bag import BagWriter
from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse, quaternion_xyzw
from knee_gap_core.values.stamps import set_stamp
from knee_gap_simulation.calibration.scene import Board, BoardCamera, ChessBoard, DotBoard, RotatedScope
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.recordings.recording import (
    BODY_POSE,
    BODY_POSE_TRUE,
    IMAGE,
    IMAGE_LATENCY_NS,
    LENS_POSE_TRUE,
    OPTICAL_FRAME,
    POSE_LATENCY_NS,
    pose_message,
)
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.imaging import jpeg
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.media import Media, Medium, RefractedLens, calibrated
from knee_gap_simulation.scope.pinhole import PinholeLens
from knee_gap_simulation.scope.tracker import TrackerNoise, tracked_body

STEP = "/knee_gap/calibration_step"
SHAFT_POSE = "/knee_gap/scope_shaft/pose"
EPOCH_NS = 1_700_000_000_000_000_000
TRACKER_HZ = 120.0
TRACKER_PHASE_S = 0.0017
MARGIN_S = 0.5  # tracked before the first image and after the last
TIP_BEYOND_LENS = 0.0012  # [m] along the shaft
BOARDS: dict[str, Board] = {"charuco": ChessBoard(), "dots": DotBoard()}
LENSES: dict[str, Lens] = {"equidistant": Lens(), "pinhole": PinholeLens()}


@dataclass(frozen=True)
class CalibrationRecording:
    """Settings of a recording: a board of BOARDS, and a lens of LENSES (as it is in air), used in `medium`.

    `video_delay` [s] is the delay of the images' stamps; the time offset is its negative.
    """

    seed: int = 7
    fps: float = 30.0
    board_s: float = 16.0
    oblique_s: float = 10.0
    pivot_s: float = 10.0
    video_delay: float = 0.012
    quality: int = 85
    noise: TrackerNoise = field(default_factory=TrackerNoise)
    board: str = "charuco"
    lens: str = "equidistant"
    medium: Medium = "air"

    def as_dict(self) -> dict[str, Any]:
        """Settings as plain values for JSON; the medium is left out if it is air."""
        values = asdict(self)
        if self.medium == "air":
            del values["medium"]
        return values

    def __post_init__(self) -> None:
        for name, choices in (("board", list(BOARDS)), ("lens", list(LENSES))):
            if getattr(self, name) not in choices:
                raise SimulationError(
                    f"the {name} must be one of {', '.join(choices)}, not {getattr(self, name)}"
                )
        if self.seed < 0:
            raise SimulationError(f"the seed must not be negative, but is {self.seed}")
        if not 5.0 <= self.fps <= 120.0:
            raise SimulationError(f"fps must lie in [5, 120] frames a second, not {self.fps:g}")
        for name in ("board_s", "oblique_s", "pivot_s"):
            if not 0.0 <= getattr(self, name) <= 120.0:
                raise SimulationError(f"{name} must lie in [0, 120] s, not {getattr(self, name):g} s")
        if not abs(self.video_delay) <= 0.2:
            raise SimulationError(f"the video's delay must lie in [-0.2, 0.2] s, not {self.video_delay:g} s")


@dataclass(frozen=True)
class CalibrationTruth:
    """True values of the calibration; `lens` is the lens in the recording's medium."""

    lens: Lens
    scope: RotatedScope
    board: Board
    T_world_board: Array
    tip: Array
    pivot: Array
    time_offset: float

    def as_dict(self) -> dict[str, Any]:
        """Ground truth as plain numbers; transforms as translation [m] and quaternion."""
        shaft = self.scope.scope.body_to_shaft()
        return {
            "lens": calibrated(self.lens).as_dict(),
            **({"index_ratio": self.lens.ratio} if isinstance(self.lens, RefractedLens) else {}),
            "T_body_lens": _plain(self.scope.body_to_lens(0.0)),
            "T_world_board": _plain(self.T_world_board),
            "shaft_direction": shaft[:3, 2].tolist(),
            "shaft_point": shaft[:3, 3].tolist(),
            "notch_angle": self.scope.notch_angle,
            "board": self.board.text,
            "tip": self.tip.tolist(),
            "pivot": self.pivot.tolist(),
            "time_offset": self.time_offset,
        }


def calibration_truth(recording: CalibrationRecording) -> CalibrationTruth:
    """A scope with assembly errors drawn from the seed: lens, body and shaft deviate from the drawing."""
    rng = np.random.default_rng([recording.seed, 0x4341])
    nominal, lens = Scope(), LENSES[recording.lens]
    scope = replace(
        nominal,
        shaft_origin=tuple((nominal.shaft_origin + rng.uniform(-0.006, 0.006, 3)).tolist()),
        shaft_turn=tuple((nominal.shaft_turn + rng.uniform(-0.06, 0.06, 3)).tolist()),
        oblique_angle=nominal.oblique_angle + float(rng.uniform(-0.02, 0.02)),
    )
    lens = replace(
        lens,
        focal_px=lens.focal_px * rng.uniform(0.97, 1.0),
        centre_x_px=lens.centre_x_px + rng.uniform(-6, 6),
        centre_y_px=lens.centre_y_px + rng.uniform(-2, 4),
    )
    turned = RotatedScope(scope, notch_angle=rng.uniform(-np.pi, np.pi))
    shaft = scope.body_to_shaft()
    return CalibrationTruth(
        lens=RefractedLens.of(lens, Media("air", recording.medium).ratio),
        scope=turned,
        board=BOARDS[recording.board],
        T_world_board=from_rotation_vectors(
            rng.uniform(-1.2, 1.2, 3), rng.uniform([-0.5, 0.8, -0.5], [0.5, 1.2, 0.5])
        ),
        tip=shaft[:3, 3] + TIP_BEYOND_LENS * shaft[:3, 2],
        pivot=rng.uniform([-0.4, 0.8, -0.4], [0.4, 1.1, 0.4]),
        time_offset=-recording.video_delay,
    )


class CalibrationMotion:
    """Poses of lens and body over time [s]: views of the board from all sides, then rotation of the shaft."""

    def __init__(self, recording: CalibrationRecording, truth: CalibrationTruth) -> None:
        self._recording, self._truth = recording, truth
        rng = np.random.default_rng([recording.seed, 0x4D4F])
        # Slow sweeps to the sides, up and down, about the view, near and far, plus deliberate shaking of the
        # hand and its tremor. Each is a few sine waves per axis: three rotations [rad], three shifts [m].
        self._waves = [
            _Waves(rng, (0.09, 0.22), 1, [0.32, 0.32, 0.42, 0.0042, 0.0035, 0.0042]),
            _Waves(rng, (0.8, 3.5), 5, [0.016, 0.016, 0.02, 0.0005, 0.0005, 0.0006]),
            _Waves(rng, (7.0, 12.0), 5, [0.0004, 0.0004, 0.0006, 0.00003, 0.00003, 0.00003]),
        ]
        self._swing = rng.uniform(0.28, 0.4, 2)

    @property
    def board_end(self) -> float:
        """Time at which the rotation of the scope starts [s]."""
        return self._recording.board_s

    @property
    def image_end(self) -> float:
        """Time of the last image, at which pivoting starts [s]."""
        return self._recording.board_s + self._recording.oblique_s

    @property
    def end(self) -> float:
        """End of the recording [s]."""
        return self.image_end + self._recording.pivot_s

    def turn(self, time: float) -> float:
        """Rotation of the shaft in the camera head [rad]."""
        since = time - self.board_end
        if since <= 0 or self._recording.oblique_s == 0:
            return 0.0
        return 0.9 * float(np.sin(2 * np.pi * min(since / self._recording.oblique_s, 1.0)))

    def lens_on_board(self, time: float) -> Array:
        """``T_board_lens`` (4, 4)."""
        value = np.sum([waves(time) for waves in self._waves], axis=0)
        width, height = self._truth.board.size
        target = from_rotation_vectors(np.zeros(3), [width / 2 + value[3], height / 2 + value[4], 0.0])
        orbit = from_rotation_vectors([value[0], value[1], 0.0], np.zeros(3))
        away = from_rotation_vectors([0.0, 0.0, value[2]], [0.0, 0.0, -0.023 + value[5]])
        return target @ orbit @ away

    def body(self, time: float) -> Array:
        """``T_world_body`` (4, 4)."""
        if time <= self.image_end:
            lens = self._truth.T_world_board @ self.lens_on_board(time)
            return lens @ inverse(self._truth.scope.body_to_lens(self.turn(time)))
        since = time - self.image_end
        swing = np.array(
            [np.sin(2 * np.pi * self._swing[0] * since), np.cos(2 * np.pi * self._swing[1] * since), 0.0]
        )
        pose = from_rotation_vectors(0.32 * swing + [1.9, 0.0, 0.4 * np.sin(0.9 * since)], np.zeros(3))
        pose[:3, 3] = self._truth.pivot - pose[:3, :3] @ self._truth.tip
        return pose


def make_calibration_bag(
    path: Path,
    recording: CalibrationRecording | None = None,
    progress: Callable[[Iterator[float], int], Iterator[float]] = lambda times, _: times,
) -> CalibrationTruth:
    """Render a calibration recording into a new bag; return its ground truth, which its metadata contain too.

    `progress` wraps the exposure times and receives their number. Raises SimulationError for settings that
    cannot be simulated and BagError if the bag cannot be written.
    """
    chosen = recording or CalibrationRecording()
    truth = calibration_truth(chosen)
    motion = CalibrationMotion(chosen, truth)
    metadata = {
        "knee_gap_calibration_truth": json.dumps(truth.as_dict()),
        "knee_gap_calibration_recording": json.dumps(chosen.as_dict()),
    }
    with BagWriter(path, metadata=metadata) as bag:
        bag.add_topic(IMAGE, "sensor_msgs/msg/CompressedImage", "sensor")
        for topic in (BODY_POSE, BODY_POSE_TRUE, LENS_POSE_TRUE, SHAFT_POSE):
            bag.add_topic(topic, "geometry_msgs/msg/PoseStamped", "sensor")
        bag.add_topic(STEP, "std_msgs/msg/String", "reliable")
        messages = [*_steps(motion, chosen), *_poses(motion, chosen, truth)]
        # Few and small compared with the images, which are written as they are rendered.
        messages.sort(key=lambda entry: entry[0])
        for record_ns, topic, message in _merged(messages, _images(motion, chosen, truth, progress)):
            bag.write(topic, message, record_ns)
    return truth


class _Waves:
    """Six smooth signals of given RMS, each the sum of a few sine waves in a band."""

    def __init__(
        self, rng: np.random.Generator, band_hz: tuple[float, float], count: int, rms: list[float]
    ) -> None:
        self._frequency = 2 * np.pi * rng.uniform(*band_hz, (count, 6))
        self._phase = rng.uniform(0, 2 * np.pi, (count, 6))
        self._amplitude = np.array(rms) * np.sqrt(2 / count)

    def __call__(self, time: float) -> Array:
        return np.asarray(self._amplitude * np.sin(self._frequency * time + self._phase).sum(axis=0))


Entry = tuple[int, str, Any]


def _merged(messages: list[Entry], images: Iterator[Entry]) -> Iterator[Entry]:
    position = 0
    for image in images:
        while position < len(messages) and messages[position][0] <= image[0]:
            yield messages[position]
            position += 1
        yield image
    yield from messages[position:]


def _steps(motion: CalibrationMotion, recording: CalibrationRecording) -> Iterator[Entry]:
    begins = {"board": -MARGIN_S, "oblique": motion.board_end, "pivot": motion.image_end, "end": motion.end}
    lengths = {
        "board": recording.board_s,
        "oblique": recording.oblique_s,
        "pivot": recording.pivot_s,
        "end": 1.0,
    }
    for name, begin in begins.items():
        if lengths[name] > 0:
            message = blank("std_msgs/msg/String")
            message.data = name
            yield _stamp_ns(begin) + POSE_LATENCY_NS, STEP, message


def _poses(
    motion: CalibrationMotion, recording: CalibrationRecording, truth: CalibrationTruth
) -> Iterator[Entry]:
    times = np.arange(-MARGIN_S + TRACKER_PHASE_S, motion.end + MARGIN_S, 1 / TRACKER_HZ)
    true = np.array([motion.body(time) for time in times])
    T_body_lens = truth.scope.body_to_lens(0.0)
    rng = np.random.default_rng([recording.seed, 0x5452])
    reported = tracked_body(true @ T_body_lens, T_body_lens, recording.noise, rng)
    # The second body, on the light post, rotates with the scope; the first is fixed to the camera head.
    shaft = truth.scope.scope.body_to_shaft()
    post = shaft @ from_rotation_vectors([0.3, 0.2, 0.1], [0.04, 0.0, -0.15])
    turns = np.array([motion.turn(time) for time in times])
    turned = from_rotation_vectors(turns[:, None] * [0.0, 0.0, 1.0], np.zeros((len(times), 3)))
    posts = true @ shaft @ turned @ inverse(shaft) @ post
    posts = tracked_body(posts, np.eye(4), recording.noise, rng)
    for time, body, body_true, post in zip(times, reported, true, posts, strict=True):
        stamp_ns = _stamp_ns(time)
        yield stamp_ns + POSE_LATENCY_NS, SHAFT_POSE, pose_message(post, stamp_ns)
        yield stamp_ns + POSE_LATENCY_NS, BODY_POSE, pose_message(body, stamp_ns)
        yield stamp_ns + POSE_LATENCY_NS, BODY_POSE_TRUE, pose_message(body_true, stamp_ns)


def _images(
    motion: CalibrationMotion,
    recording: CalibrationRecording,
    truth: CalibrationTruth,
    progress: Callable[[Iterator[float], int], Iterator[float]],
) -> Iterator[Entry]:
    camera = BoardCamera(truth.board, truth.lens, truth.scope, recording.seed)
    times = np.arange(0.0, motion.image_end, 1 / recording.fps)
    for time in progress(iter(times), len(times)):
        T_board_lens, turn = motion.lens_on_board(time), motion.turn(time)
        stamp_ns = _stamp_ns(time + recording.video_delay)
        record_ns = stamp_ns + IMAGE_LATENCY_NS
        message = blank("sensor_msgs/msg/CompressedImage")
        set_stamp(message.header, stamp_ns)
        message.header.frame_id = OPTICAL_FRAME
        message.format = "bgr8; jpeg compressed bgr8"
        message.data = np.frombuffer(jpeg(camera.frame(T_board_lens, turn), recording.quality), np.uint8)
        yield record_ns, IMAGE, message
        # The ground truth has the exposure time by the tracker's clock, not the delayed stamp of the image.
        yield record_ns, LENS_POSE_TRUE, pose_message(truth.T_world_board @ T_board_lens, _stamp_ns(time))


def _stamp_ns(time: float) -> int:
    return EPOCH_NS + round(time * 1e9)


def _plain(T: Array) -> dict[str, list[float]]:
    return {"translation": T[:3, 3].tolist(), "quaternion_xyzw": quaternion_xyzw(T).tolist()}
