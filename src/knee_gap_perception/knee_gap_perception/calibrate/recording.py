"""The recording of a calibration: its request, its poses, and its views of the board."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibrate.bag_input import LONGEST_BAG, CalibrationBag, CalibrationBags
from knee_gap_perception.calibrate.measurements.boards import Board
from knee_gap_perception.calibrate.measurements.pose_track import PoseTrack
from knee_gap_perception.calibrate.observations import Observations, observe, still_stamps
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.calibration.calibration_rules import MOST_CLOCK_OFFSET
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount

Progress = Callable[[Iterable[int], str], Iterable[int]]


@dataclass(frozen=True)
class Request:
    """Request of a calibration: one bag under the name "", or one per step under the step's name."""

    bags: Mapping[str, Path]
    board: Board | None = None
    image_topic: str = "/knee_gap/image_raw/compressed"
    pose_topic: str = "/knee_gap/scope_body/pose"
    scope_pose_topic: str | None = None
    model: LensModel = field(default_factory=lambda: LensModel("equidistant"))
    mount: Mount = Mount.CAMERA_HEAD
    views: int = 48
    free_intrinsics: bool = True
    time_offset: float | None = None
    max_offset: float = 0.25
    begin: float = 0.0
    end: float = float("inf")

    def __post_init__(self) -> None:
        if not 4 <= self.views <= 500:
            raise PerceptionError(f"--views must lie in [4, 500], not {self.views}")
        if not 0.0 < self.max_offset <= 2.0:
            raise PerceptionError(f"--max-offset must lie in (0, 2] s, not {self.max_offset}")
        if self.time_offset is not None and not abs(self.time_offset) <= MOST_CLOCK_OFFSET:
            raise PerceptionError(
                f"--time-offset must lie within {MOST_CLOCK_OFFSET:g} s, not {self.time_offset:g} s"
            )
        if not 0.0 <= self.begin < min(self.end, LONGEST_BAG):
            raise PerceptionError(
                f"--begin must lie before --end, and neither before the bag's start: not {self.begin:g} s "
                f"and {self.end:g} s"
            )


class Recording:
    """Bags and the data read from them, once for all steps."""

    def __init__(self, request: Request, progress: Progress) -> None:
        self.request = request
        self._progress = progress
        self._bags = CalibrationBags(request.bags, request.begin, request.end)
        self._bags.require_apart(request.pose_topic)
        self._track: PoseTrack | None = None
        self._seen: dict[str, Observations] = {}

    @property
    def steps(self) -> list[str]:
        """Steps by the bags' names or marks."""
        return self._bags.steps()

    def images(self, part: str) -> Iterator[tuple[int, npt.NDArray[np.uint8]]]:
        """Stamp [ns] and image of every image of a part, with progress."""
        bag = self._bags.part(part)
        total = len(bag.image_stamps(self.request.image_topic))
        steps = self._progress(range(total), "measuring the image motion")
        for _, pair in zip(steps, bag.images(self.request.image_topic), strict=False):
            yield pair

    def raw_poses(self, part: str) -> Array:
        """Poses (n, 4, 4) of the body in a part, as recorded."""
        return self._bags.part(part).poses(self.request.pose_topic)[1]

    def second_track(self, topic: str) -> PoseTrack:
        """Poses of another body."""
        return PoseTrack.of(*self._bags.poses(topic))

    def track(self) -> PoseTrack:
        """Poses of the body, over all bags."""
        if self._track is None:
            self._track = PoseTrack.of(*self._bags.poses(self.request.pose_topic))
        return self._track

    def observe(self, part: str, calibration: Calibration | None) -> Observations:
        """Views of the board in a part.

        Raises PerceptionError if no board is named, if the body is not tracked at any image, or if the
        calibration is for images of another size.
        """
        request = self.request
        if request.board is None:
            raise PerceptionError("which board is in the images? Name it with --board")
        if part not in self._seen:
            bag = self._bags.part(part)
            try:
                track: PoseTrack | None = self.track()
            except PerceptionError:
                track = None
            stamps = bag.image_stamps(request.image_topic)
            if len(stamps) == 0:
                raise PerceptionError(f"no image of {request.image_topic} is in {_words(bag)} of {bag.path}")
            chosen = still_stamps(stamps, request.views, track, self.offset(calibration))
            if len(chosen) == 0:
                raise PerceptionError(
                    f"none of the {len(stamps)} images was taken while the body was tracked"
                )
            self._seen[part] = observe(bag, request.image_topic, request.board, chosen, self._progress)
        seen = self._seen[part]
        if calibration is not None:
            calibration.require_image_size(seen.width_px, seen.height_px)
        return seen

    def offset(self, calibration: Calibration | None) -> float:
        """Initial time offset: given, calibrated before, or 0."""
        if self.request.time_offset is not None:
            return self.request.time_offset
        return calibration.clock.offset if calibration and calibration.clock else 0.0


def _words(part: CalibrationBag) -> str:
    """The part of a bag that is read, in words."""
    whole = part.begin == 0.0 and not np.isfinite(part.end)
    end = f"{part.end:g} s" if np.isfinite(part.end) else "the end"
    return "any part" if whole else f"the part from {part.begin:g} s to {end}"
