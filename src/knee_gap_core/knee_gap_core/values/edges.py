"""Gap edges of one image: two points of the anatomy, one just inside each edge of the gap, and the edges."""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Self

import numpy as np
import numpy.typing as npt

# The optical frame of the lens where the camera_info names no other.
LENS_FRAME = "arthroscope_optical"
# Rounding on the way, not a wrong vector.
UNIT_TOLERANCE = 1e-6
ROUNDING = 1e-6
# Standard deviation of an edge that is all but exact [rad].
RIM_DEVIATION = 1e-4


class EdgeStatus(IntEnum):
    """Whether the points may be used; the constants of knee_gap_msgs/GapEdges."""

    UNKNOWN = 0
    VALID = 1
    NO_GAP = 2
    LOW_CONTRAST = 3
    OUT_OF_VIEW = 4


class EdgeKind(IntEnum):
    """What kind of edge a point lies beside; the constants of knee_gap_msgs/GapEdges."""

    UNKNOWN = 0
    RIM = 1
    CONTOUR = 2
    SHADING = 3


class EdgeState(IntEnum):
    """Whether an image shows an edge at the section; the constants of knee_gap_msgs/GapEdges."""

    UNKNOWN = 0
    SEEN = 1
    AT_BORDER = 2


@dataclass(frozen=True, eq=False)
class SectionEdges:
    """The two edges of the opening on a line across it, at one section.

    `states` (2,); `bearings` (2, 3) unit vectors in the lens frame; `deviations` (2,), the standard deviation
    of each direction across the opening [rad]; `error` bounds the larger error [rad]; `pixels` (2, 2) columns
    and rows. Unknown numbers are NaN.
    """

    states: tuple[EdgeState, EdgeState] = (EdgeState.UNKNOWN, EdgeState.UNKNOWN)
    bearings: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 3), np.nan))
    deviations: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    error: float = float("nan")
    pixels: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 2), np.nan))

    @property
    def seen(self) -> bool:
        """Whether the image shows both edges."""
        return all(state is EdgeState.SEEN for state in self.states)


@dataclass(frozen=True, eq=False)
class GapEdges:
    """The two points G0 and G1 in one image, and the edges beside them; the fields of knee_gap_msgs/GapEdges.

    `stamp_ns` is the exposure time [ns]; `frame_id` the optical frame of the lens. `track_id` is 0 without a
    track; the same id means the same two points. `bearings` (2, 3) are unit vectors, `pixels` (2, 2) columns
    and rows, `covariances` (2, 3, 3) those of the unit vectors [rad^2], and `angular_error` bounds the angle
    between each bearing and its true direction [rad]. `hidden` is whether the image does not show a point, so
    that its bearing is a prediction from earlier images: they have been counted, and to count them again
    would make a fit too sure. `pose_used` is whether the pose of the lens guided the search, so that bearings
    and pose share some of their errors. `camera_errors` (2, 3, k) are the displacements of the bearings by
    one standard deviation of each of the k independent errors of the camera's own numbers [rad], which all
    images share. `section` holds the edges of the opening where an instrument would pass, `sections` those at
    more places along it. Unknown numbers are NaN.
    """

    stamp_ns: int
    frame_id: str
    status: EdgeStatus
    track_id: int
    bearings: npt.NDArray[np.float64]
    pixels: npt.NDArray[np.float64]
    kinds: tuple[EdgeKind, EdgeKind]
    covariances: npt.NDArray[np.float64]
    angular_error: float
    hidden: tuple[bool, bool] = (False, False)
    pose_used: bool = False
    camera_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3, 0)))
    section: SectionEdges = field(default_factory=SectionEdges)
    sections: tuple[SectionEdges, ...] = ()

    @classmethod
    def without_points(cls, stamp_ns: int, frame_id: str, status: EdgeStatus, track_id: int = 0) -> Self:
        """Edges of an image in which the points are not known."""
        return cls(
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            status=status,
            track_id=track_id,
            bearings=np.full((2, 3), np.nan),
            pixels=np.full((2, 2), np.nan),
            kinds=(EdgeKind.UNKNOWN, EdgeKind.UNKNOWN),
            covariances=np.full((2, 3, 3), np.nan),
            angular_error=float("nan"),
        )

    @classmethod
    def of_points(
        cls,
        stamp_ns: int,
        track_id: int,
        bearings: npt.NDArray[np.float64],
        covariances: npt.NDArray[np.float64],
        angular_error: float,
    ) -> Self:
        """VALID edges of two points by their directions, without a picture: for simulated scopes."""
        nothing = cls.without_points(stamp_ns, LENS_FRAME, EdgeStatus.VALID, track_id)
        return replace(nothing, bearings=bearings, covariances=covariances, angular_error=angular_error)

    def with_rims_at_points(self) -> Self:
        """The same, with the points as rims of the opening: for simulated scopes."""
        seen = (EdgeState.SEEN, EdgeState.SEEN)
        rims = SectionEdges(seen, self.bearings, np.full(2, RIM_DEVIATION), 3.0 * RIM_DEVIATION)
        return replace(self, kinds=(EdgeKind.RIM, EdgeKind.RIM), section=rims)

    @property
    def usable(self) -> bool:
        """Whether the points were seen or predicted, within a track."""
        return self.status is EdgeStatus.VALID and self.track_id != 0

    def flaw(self) -> str:
        """Why the edges cannot be used, in words; empty if they can."""
        if not self.usable:
            return f"the image gave no usable edges (edge status {int(self.status)})"
        if any(self.hidden):
            return "a point is hidden in the image: its bearing is a prediction, not a measurement"
        if not (np.isfinite(self.bearings).all() and np.isfinite(self.covariances).all()):
            return "the edges are VALID, but have numbers that are not finite"
        if not np.isfinite(self.camera_errors).all():
            return "the edges are VALID, but have errors of the camera that are not finite"
        if np.abs(np.linalg.norm(self.bearings, axis=1) - 1.0).max() > UNIT_TOLERANCE:
            return "the edges are VALID, but have bearings that are not unit vectors"
        if not 0.0 <= self.angular_error < np.pi / 2:
            return "the edges are VALID, but have an angular error outside [0, pi/2)"
        if self.angular_error < (1.0 - ROUNDING) * np.sqrt(np.linalg.eigvalsh(self.covariances).max()):
            # A bounded error has no standard deviation above its bound.
            return "the edges are VALID, but have an angular error below its own standard deviation"
        return ""
