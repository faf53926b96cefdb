"""What is published of the gap, and of an observation of its edges: the values that go in and come out."""

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.rejection import Rejection

NAN = float("nan")
# Rounding on the way, not a wrong vector.
UNIT_TOLERANCE = 1e-6
# Kind of an edge, of knee_gap_msgs/GapEdges, and standard deviation of an edge that is all but exact [rad].
RIM, RIM_DEVIATION = 1, 1e-4
ROUNDING = 1e-6


class GapStatus(IntEnum):
    """Whether the numbers may be acted on; the constants of knee_gap_msgs/GapEstimate."""

    UNKNOWN = 0
    VALID = 1
    NO_EDGES = 2
    TRACKING_LOST = 3
    INSUFFICIENT_PARALLAX = 4
    OUT_OF_SYNC = 5
    JOINT_MOVED = 6


class EdgeState(IntEnum):
    """Whether an image shows an edge; the constants of knee_gap_msgs/GapEdges."""

    UNKNOWN = 0
    SEEN = 1
    AT_BORDER = 2


@dataclass(frozen=True, eq=False)
class EdgeSection:
    """The two edges of the opening at one section of it, in the lens frame of one image.

    `bearings` (2, 3) unit vectors; `deviations` (2,), the standard deviation of each across the opening
    [rad]; `error` bounds the larger error [rad]. Numbers of an edge that is not seen are NaN.
    """

    states: tuple[int, int] = (EdgeState.UNKNOWN, EdgeState.UNKNOWN)
    bearings: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 3), NAN))
    deviations: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(2, NAN))
    error: float = NAN


@dataclass(frozen=True, eq=False)
class EdgeObservation:
    """The two points in one image.

    `stamp_ns` is the exposure time [ns]; `bearings` (2, 3) unit vectors in the lens frame; `covariances`
    (2, 3, 3) of the unit vectors [rad^2]; `angular_error` bounds each bearing's angle to the truth [rad].
    `usable` is false where the points were not seen; the rest is then unknown. `status` is the sender's code,
    `frame_id` the lens frame. `hidden` is true where a bearing is a prediction from earlier images: those
    have been counted, and counting them again would make the fit too sure. `pose_used` says that the pose of
    the lens guided the search, so that bearings and pose share some of their errors. `camera_errors`
    (2, 3, k) are the displacements of the bearings by one standard deviation of each of the k errors of the
    camera's own numbers [rad], which all images share. `kinds` are the sender's codes of the edges beside the
    points. `section` holds those edges where an instrument would pass, `sections` those at more places.
    """

    stamp_ns: int
    track_id: int
    usable: bool
    bearings: npt.NDArray[np.float64]
    covariances: npt.NDArray[np.float64]
    angular_error: float
    status: int = 0
    frame_id: str = "arthroscope_optical"
    hidden: bool = False
    pose_used: bool = False
    camera_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3, 0)))
    kinds: tuple[int, int] = (0, 0)
    section: EdgeSection = field(default_factory=lambda: EdgeSection())
    sections: tuple[EdgeSection, ...] = ()

    def with_rims_at_points(self) -> "EdgeObservation":
        """The same, with the points as rims of the opening: for scopes simulated without pictures."""
        rims = EdgeSection(
            (EdgeState.SEEN, EdgeState.SEEN), self.bearings, np.full(2, RIM_DEVIATION), 3.0 * RIM_DEVIATION
        )
        return replace(self, kinds=(RIM, RIM), section=rims)

    def flaw(self) -> str:
        """Why the observation cannot be used, in words; empty if it can."""
        if not self.usable:
            return f"the image gave no usable edges (edge status {self.status})"
        if self.hidden:
            return "a point is hidden in the image: its bearing is a prediction, not a measurement"
        if not (np.isfinite(self.bearings).all() and np.isfinite(self.covariances).all()):
            return "the edges say valid and carry numbers that are not finite"
        if not np.isfinite(self.camera_errors).all():
            return "the edges say valid and carry errors of the camera that are not finite"
        if np.abs(np.linalg.norm(self.bearings, axis=1) - 1.0).max() > UNIT_TOLERANCE:
            return "the edges say valid and carry bearings that are no unit vectors"
        if not 0.0 <= self.angular_error < np.pi / 2:
            return "the edges say valid and carry an angular error outside [0, pi/2)"
        if self.angular_error < (1.0 - ROUNDING) * np.sqrt(np.linalg.eigvalsh(self.covariances).max()):
            # No error that is bounded has a standard deviation above its bound.
            return "the edges say valid and carry an angular error below its own standard deviation"
        return ""


@dataclass(frozen=True, eq=False)
class GapEstimate:
    """One answer; the fields of knee_gap_msgs/GapEstimate, in metres and radians, NaN where unknown.

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
        """Why the status is not VALID, in words; empty where it is."""
        return str(self.rejection) if self.rejection is not None else ""
