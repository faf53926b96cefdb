"""Estimate of the gap of one image: its numbers, bounds and status."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.rejection import Rejection

NAN = float("nan")


class GapStatus(IntEnum):
    """Whether the numbers may be acted on; the constants of knee_gap_msgs/GapEstimate."""

    UNKNOWN = 0
    VALID = 1
    NO_EDGES = 2
    TRACKING_LOST = 3
    INSUFFICIENT_PARALLAX = 4
    OUT_OF_SYNC = 5
    JOINT_MOVED = 6


@dataclass(frozen=True, eq=False)
class GapEstimate:
    """The estimate at one image: the fields of knee_gap_msgs/GapEstimate [m, rad]; NaN where unknown.

    `points` (2, 3), `instrument_point` (3,) and `instrument_axis` (3,) are in the frame `frame_id`. `shares`
    (6,) divide the variance among image, lens position, lens rotation, common part, edges and shape.
    `rejection` is why the status is not VALID, None if it is.
    """

    stamp_ns: int
    frame_id: str
    status: GapStatus
    track_id: int = 0
    interval: str = "worst_case"
    gap: float = NAN
    gap_min: float = NAN
    gap_max: float = NAN
    snr: float = NAN
    confidence_level: float = NAN
    confidence_min: float = NAN
    confidence_max: float = NAN
    instrument_point: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(3, NAN))
    instrument_axis: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(3, NAN))
    point_distance: float = NAN
    point_distance_min: float = NAN
    point_distance_max: float = NAN
    point_distance_confidence_min: float = NAN
    point_distance_confidence_max: float = NAN
    baseline: float = NAN
    parallax: float = NAN
    view_count: int = 0
    translation_to_target: float = NAN
    points: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 3), NAN))
    shares: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(6, NAN))
    rejection: Rejection | None = None

    @property
    def reason(self) -> str:
        """Why the status is not VALID, in words; empty if it is."""
        return str(self.rejection) if self.rejection is not None else ""
