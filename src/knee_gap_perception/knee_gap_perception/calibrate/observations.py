"""Views of the board from a recorded bag: the stillest images, evenly over time, with the notch."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibrate.bag_input import CalibrationBag
from knee_gap_perception.calibrate.measurements.boards import Board, BoardView
from knee_gap_perception.calibrate.measurements.pose_track import PoseTrack
from knee_gap_perception.calibrate.solvers.hand_eye_bundle import TrackedView
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.image.field_of_view import FieldOfViewFinder
from knee_gap_perception.scope_rotation.notch import Notch, find_notch

LEVER = 0.2  # [m] from body to lens: converts a body's rotation to motion of the lens


class Observation(NamedTuple):
    """A view of the board, and the notch, None if it was not found."""

    board: BoardView
    notch: Notch | None

    @property
    def notch_angle(self) -> float:
        """Angle of the notch [rad], NaN if it was not found."""
        return self.notch.angle if self.notch else float("nan")


class Observations(NamedTuple):
    """The views in which the board was found, the size of all images, and the number of images searched."""

    views: tuple[Observation, ...]
    width_px: int
    height_px: int
    image_count: int


def still_stamps(
    stamps_ns: npt.NDArray[np.int64], count: int, track: PoseTrack | None, time_offset: float
) -> npt.NDArray[np.int64]:
    """At most `count` stamps, evenly over time: in each interval the one at which the lens moves least."""
    stretches = np.array_split(stamps_ns, min(count, len(stamps_ns)))
    if track is None:
        return np.array([stretch[len(stretch) // 2] for stretch in stretches])
    chosen = []
    for stretch in stretches:
        tracked = stretch + round(time_offset * 1e9)
        tracked, stretch = tracked[track.covers(tracked)], stretch[track.covers(tracked)]
        if len(stretch):
            rate = track.twist_rates(tracked)
            speed = LEVER * np.linalg.norm(rate[:, :3], axis=1) + np.linalg.norm(rate[:, 3:], axis=1)
            chosen.append(stretch[speed.argmin()])
    return np.array(chosen, dtype=np.int64)


def observe(
    bag: CalibrationBag,
    topic: str,
    board: Board,
    stamps_ns: npt.NDArray[np.int64],
    progress: Callable[[Iterable[int], str], Iterable[int]],
) -> Observations:
    """Find the board and the notch in the images with the given stamps.

    Raises PerceptionError if the images change their size, or if none of them is in the bag.
    """
    wanted, finder = set(stamps_ns.tolist()), FieldOfViewFinder()
    views, size, count = [], None, 0
    images = bag.images(topic)
    for _ in progress(range(len(wanted)), "searching the board"):
        stamp, image = next(((s, i) for s, i in images if s in wanted), (None, None))
        if stamp is None or image is None:
            break
        count += 1
        shape = (image.shape[1], image.shape[0])
        if size is not None and shape != size:
            raise PerceptionError(f"the images change from {size[0]}x{size[1]} to {shape[0]}x{shape[1]} px")
        size = shape
        view = board.find(image, stamp)
        if view is not None:
            field = finder.find(image)
            notch = find_notch(image, field) if field is not None else None
            views.append(Observation(view, notch))
    images.close()
    if size is None:
        raise PerceptionError(f"no image of {topic} is in this part of {bag.path}")
    return Observations(tuple(views), *size, count)


def tracked_views(
    views: Sequence[BoardView], turns: Array, turn_sigmas: Array, track: PoseTrack, time_offset: float
) -> list[TrackedView]:
    """Views with the body's pose at their exposure; those without a pose or a rotation are left out."""
    stamps = np.array([view.stamp_ns for view in views], dtype=np.int64) + round(time_offset * 1e9)
    good = track.covers(stamps) & np.isfinite(turns)
    poses, rates = track.at(stamps), track.twist_rates(stamps)
    return [
        TrackedView(views[i], poses[i], rates[i], float(turns[i]), float(turn_sigmas[i]))
        for i in np.flatnonzero(good)
    ]


def common_angle(angles: Array, tolerance: float) -> float:
    """Median of the largest group of angles [rad] within a tolerance of one another; NaN if none is known."""
    known = angles[np.isfinite(angles)]
    if len(known) == 0:
        return float("nan")
    apart = wrapped(known[:, None] - known[None])
    best = int((np.abs(apart) < tolerance).sum(axis=1).argmax())
    group = apart[np.abs(apart[:, best]) < tolerance, best]
    return float(wrapped(known[best] + np.median(group)))


def wrapped(angles: npt.ArrayLike) -> Array:
    """Angles [rad] brought into [-pi, pi)."""
    return np.asarray((np.asarray(angles, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi)
