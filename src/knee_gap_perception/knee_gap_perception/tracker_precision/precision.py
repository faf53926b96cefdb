"""Precision of a tracker: DT and omega of a body, at rest and in motion (the paper's section II-F).

The paper gives RMS lengths of the error vectors of stationary and of moving markers. It does not describe how
the error of a moving marker was determined without its true path. Here:

- **At rest**, the error is the distance from the mean of the segment, with n - 1 degrees of freedom. The body
  must be put down: in a hand, the tremor would count as the tracker's error.
- **In motion**, it is the distance from a smooth path: a cubic through the neighbouring poses. A pose pulls
  the path towards itself by its leverage h, so the sum of squares is divided by the sum of 1 - h. The length
  of the neighbourhood is the one that predicts left-out poses best: longer ones cannot follow the hand,
  shorter ones follow the noise.
- **Slow errors**: a smooth path also follows errors that change slowly, which are part of the error at rest.
  Their part at rest is therefore added to the error in motion. Without a segment at rest, it is unknown.

Errors that depend on the position in the room (from the calibration of the cameras) are not included.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan, radians, sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import savgol_coeffs
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

DEGREE = 3
NEIGHBOURHOODS = (5, 7, 9, 11, 15, 21, 31, 45)
# At rest, the mean position and orientation change by less than this between the halves of a window [s] and
# of the whole segment, or by no more than white noise of the measured size explains.
REST_WINDOW = 0.5
MOST_CHANGE = (0.125e-3, radians(0.025))
MOST_CREEP = (0.05e-3, radians(0.01))
SHORTEST = 1.0
# Rotations are compared in pieces of this many neighbourhoods, so that memory stays flat.
CHUNK = 20_000


class Segment(NamedTuple):
    """Poses start to stop (exclusive) of a recording, at rest or in motion."""

    start: int
    stop: int
    at_rest: bool


@dataclass(frozen=True, eq=False)
class PoseSeries:
    """Poses of one body: `time` (n,) [s], rising; `position` (n, 3) [m]; unit `quaternion_xyzw` (n, 4)."""

    name: str
    time: Array
    position: Array
    quaternion_xyzw: Array

    def at_point(self, lever: npt.ArrayLike) -> "PoseSeries":
        """Return the poses of a point of the body, `lever` (3,) [m] from its origin in its own axes."""
        moved = self.position + Rotation.from_quat(self.quaternion_xyzw).apply(np.asarray(lever, dtype=float))
        return PoseSeries(self.name, self.time, moved, self.quaternion_xyzw)


class ErrorSum(NamedTuple):
    """Sum of squared error lengths and its degrees of freedom, which add up over segments and recordings."""

    squares: float = 0.0
    freedom: float = 0.0
    poses: int = 0

    @property
    def rms(self) -> float:
        """RMS length of the error vector; NaN without data."""
        return sqrt(self.squares / self.freedom) if self.freedom > 0 else nan

    def plus(self, other: "ErrorSum") -> "ErrorSum":
        """Return both together."""
        return ErrorSum(self.squares + other.squares, self.freedom + other.freedom, self.poses + other.poses)


NOTHING = ErrorSum()


@dataclass(frozen=True)
class ErrorSums:
    """Errors of one quantity: at rest, at rest against the smooth path, and in motion against it."""

    rest: ErrorSum = NOTHING
    rest_smooth: ErrorSum = NOTHING
    motion_smooth: ErrorSum = NOTHING

    def plus(self, other: "ErrorSums") -> "ErrorSums":
        """Return both together."""
        return ErrorSums(
            self.rest.plus(other.rest),
            self.rest_smooth.plus(other.rest_smooth),
            self.motion_smooth.plus(other.motion_smooth),
        )

    @property
    def slow(self) -> float:
        """RMS of the part at rest that a smooth path follows; NaN without a segment at rest."""
        excess = self.rest.rms**2 - self.rest_smooth.rms**2
        return sqrt(max(excess, 0.0)) if np.isfinite(excess) else nan

    @property
    def motion(self) -> float:
        """RMS in motion, including the slow part if it is known; NaN without motion."""
        slow = self.slow
        return sqrt(self.motion_smooth.rms**2 + (0.0 if np.isnan(slow) else slow**2))

    @property
    def worse(self) -> float:
        """The larger of the errors at rest and in motion, for use in measurements."""
        return float(np.nanmax([self.rest.rms, self.motion]))


@dataclass(frozen=True, eq=False)
class Precision:
    """Precision of one recording: sums for position [m^2] and rotation [rad^2], and data of the plot.

    `position_error`, `rotation_error` (n, 3) are each pose's error, NaN if unknown; `neighbourhoods` are the
    numbers of poses in the smooth paths of position and rotation.
    """

    series: PoseSeries
    segments: tuple[Segment, ...]
    position: ErrorSums
    rotation: ErrorSums
    position_error: Array
    rotation_error: Array
    neighbourhoods: tuple[int, int]


def tracker_precision(series: PoseSeries) -> Precision:
    """Return the precision of a recording.

    Raises PerceptionError for a recording that is too short, or in which all poses are equal.
    """
    runs = [run for run in _gapless(series.time) if run.stop - run.start >= 4 * NEIGHBOURHOODS[0]]
    if not runs:
        raise PerceptionError(f"{series.name}: no sequence of poses without a gap is long enough")
    residuals = {size: _smooth_residuals(series, runs, size) for size in _sizes(runs)}
    noise = _rms(residuals[NEIGHBOURHOODS[0]][0]), _rms(residuals[NEIGHBOURHOODS[0]][1])
    if not noise[0] > 0.0:
        raise PerceptionError(f"{series.name}: all poses are equal; this is not a recording of a tracker")
    segments = [segment for run in runs for segment in _split(series, run, noise)]
    if not segments:
        raise PerceptionError(
            f"{series.name}: no segment at rest or in motion for {SHORTEST:g} s without a gap"
        )
    sizes = _best_size(residuals, segments, 0), _best_size(residuals, segments, 1)
    smooth = [residuals[size][quantity] for quantity, size in enumerate(sizes)]
    sums, errors = [ErrorSums(), ErrorSums()], [array.copy() for array in smooth]
    for segment in segments:
        part = slice(segment.start, segment.stop)
        from_mean = _from_mean(series, part) if segment.at_rest else (None, None)
        for quantity, array in enumerate(from_mean):
            if array is not None:
                errors[quantity][part] = array
            sums[quantity] = sums[quantity].plus(_sums(smooth[quantity][part], array, sizes[quantity]))
    return Precision(series, tuple(segments), sums[0], sums[1], errors[0], errors[1], sizes)


def pooled(precisions: Sequence[Precision]) -> tuple[ErrorSums, ErrorSums]:
    """Sums of position and rotation over several recordings."""
    position, rotation = ErrorSums(), ErrorSums()
    for precision in precisions:
        position, rotation = position.plus(precision.position), rotation.plus(precision.rotation)
    return position, rotation


def _sums(smooth: Array, from_mean: Array | None, neighbourhood: int) -> ErrorSums:
    squares = (smooth[np.isfinite(smooth).all(axis=1)] ** 2).sum(axis=1)
    leverage = float(_weights(neighbourhood)[neighbourhood // 2])
    summed = ErrorSum(float(squares.sum()), len(squares) * (1.0 - leverage), len(squares))
    if from_mean is None:
        return ErrorSums(motion_smooth=summed)
    rest = ErrorSum(float((from_mean**2).sum()), len(from_mean) - 1.0, len(from_mean))
    return ErrorSums(rest=rest, rest_smooth=summed)


def _weights(neighbourhood: int) -> Array:
    """Weights of the neighbours in the cubic's value at the middle one."""
    return np.asarray(savgol_coeffs(neighbourhood, min(DEGREE, neighbourhood - 2), use="dot"))


def _gapless(time: Array) -> list[Segment]:
    """Runs of poses without a lost frame between them."""
    if len(time) < 2:
        return []
    intervals = np.diff(time)
    breaks = np.flatnonzero(intervals > 1.5 * np.median(intervals)) + 1
    edges = [0, *breaks.tolist(), len(time)]
    return [Segment(start, stop, False) for start, stop in pairwise(edges)]


def _sizes(runs: Iterable[Segment]) -> list[int]:
    """Lengths of neighbourhoods that fit into the longest run."""
    longest = max(run.stop - run.start for run in runs)
    return [size for size in NEIGHBOURHOODS if size <= longest // 2]


def _best_size(
    residuals: Mapping[int, tuple[Array, Array]], segments: Sequence[Segment], quantity: int
) -> int:
    """Length of the neighbourhood that predicts left-out poses best, in motion if there is any.

    The residual of a left-out pose is its residual over 1 - h. The worst hundredth is left out: a few
    outliers must not choose.
    """
    judged = [segment for segment in segments if not segment.at_rest] or segments
    scores = {}
    for size, arrays in residuals.items():
        errors = np.vstack([arrays[quantity][segment.start : segment.stop] for segment in judged])
        squares = np.sort((errors[np.isfinite(errors).all(axis=1)] ** 2).sum(axis=1))
        left_out = 1.0 - float(_weights(size)[size // 2])
        scores[size] = float(np.mean(squares[: max(1, len(squares) * 99 // 100)])) / left_out**2
    return min(scores, key=lambda size: scores[size])


def _smooth_residuals(series: PoseSeries, runs: Iterable[Segment], neighbourhood: int) -> tuple[Array, Array]:
    """Residuals of positions and rotations (n, 3) against the cubic; NaN at the ends of the runs."""
    position, rotation = np.full((2, len(series.time), 3), np.nan)
    weights, half = _weights(neighbourhood), neighbourhood // 2
    for run in runs:
        for start in range(run.start, run.stop, CHUNK):
            middle = np.arange(max(start, run.start + half), min(start + CHUNK, run.stop - half))
            if not len(middle):
                continue
            around = middle[:, None] + np.arange(-half, half + 1)
            position[middle] = series.position[middle] - np.einsum(
                "j,njk->nk", weights, series.position[around]
            )
            rotation[middle] = -np.einsum("j,njk->nk", weights, _turns(series, middle, around))
    return position, rotation


def _turns(series: PoseSeries, middle: npt.NDArray[np.int64], around: npt.NDArray[np.int64]) -> Array:
    """Rotations (n, m, 3) [rad] of the neighbours against the middle one, about the fixed axes."""
    count, neighbourhood = around.shape
    neighbours = Rotation.from_quat(series.quaternion_xyzw[around.ravel()])
    centres = Rotation.from_quat(np.repeat(series.quaternion_xyzw[middle], neighbourhood, axis=0))
    return np.asarray((neighbours * centres.inv()).as_rotvec()).reshape(count, neighbourhood, 3)


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.nanmean((errors**2).sum(axis=1))))


def _from_mean(series: PoseSeries, part: slice) -> tuple[Array, Array]:
    """Errors of position and rotation (n, 3) against the segment's means."""
    position = series.position[part]
    rotation = Rotation.from_quat(series.quaternion_xyzw[part])
    turned = (rotation * rotation.mean().inv()).as_rotvec()
    return position - position.mean(axis=0), np.asarray(turned)


def _split(series: PoseSeries, run: Segment, noise: tuple[float, float]) -> list[Segment]:
    """Segments at rest and in motion of a run; stretches that are too short for either are left out."""
    moves = _moves(series, run, noise)
    edges = [0, *(np.flatnonzero(np.diff(moves.astype(np.int8))) + 1).tolist(), len(moves)]
    period = float(np.median(np.diff(series.time[run.start : run.stop])))
    shortest = round(SHORTEST / period)
    segments = []
    for first, last in pairwise(edges):
        start, stop = run.start + first, run.start + last
        if stop - start < shortest:
            continue
        if moves[first]:
            segments.append(Segment(start, stop, False))
        else:
            # A body that creeps from one end to the other is in slow motion.
            steady = _steady(series, start, stop, noise, shortest)
            segments += steady or [Segment(start, stop, False)]
    return segments


def _moves(series: PoseSeries, run: Segment, noise: tuple[float, float]) -> npt.NDArray[np.bool_]:
    """Whether the body moves at each pose: the means of the half windows before and after it differ."""
    part = slice(run.start, run.stop)
    period = float(np.median(np.diff(series.time[part])))
    half = max(2, round(REST_WINDOW / period / 2))
    # Over a long path rotations add up, so they are taken step by step.
    rotation = Rotation.from_quat(series.quaternion_xyzw[part])
    turns = np.vstack([np.zeros(3), np.cumsum((rotation[1:] * rotation[:-1].inv()).as_rotvec(), axis=0)])
    moves = np.zeros(run.stop - run.start, dtype=bool)
    for values, sigma, most in zip((series.position[part], turns), noise, MOST_CHANGE, strict=True):
        if len(values) <= 2 * half:
            return np.ones(len(values), dtype=bool)
        sums = np.vstack([np.zeros(3), np.cumsum(values - values[0], axis=0)])
        means = (sums[half:] - sums[:-half]) / half
        change = np.linalg.norm(means[half:] - means[:-half], axis=1)
        limit = max(4.0 * sigma * sqrt(2.0 / half), most)
        inside = slice(half, half + len(change))
        moves[inside] |= change > limit
    return moves


def _steady(
    series: PoseSeries, start: int, stop: int, noise: tuple[float, float], shortest: int
) -> list[Segment]:
    """Parts of a stretch at rest that do not creep: the means of their halves agree within the noise."""
    if stop - start < shortest:
        return []
    middle = (start + stop) // 2
    position = series.position
    crept = np.linalg.norm(position[start:middle].mean(axis=0) - position[middle:stop].mean(axis=0))
    first = Rotation.from_quat(series.quaternion_xyzw[start:middle]).mean()
    second = Rotation.from_quat(series.quaternion_xyzw[middle:stop]).mean()
    turned = float((first * second.inv()).magnitude())
    white = 4.0 * sqrt(4.0 / (stop - start))
    if crept <= max(white * noise[0], MOST_CREEP[0]) and turned <= max(white * noise[1], MOST_CREEP[1]):
        return [Segment(start, stop, True)]
    return [
        *_steady(series, start, middle, noise, shortest),
        *_steady(series, middle, stop, noise, shortest),
    ]
