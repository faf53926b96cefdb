"""Two points of the anatomy, one just inside each edge of the gap, as one image shows them."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Self

import numpy as np
import numpy.typing as npt


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


@dataclass(frozen=True)
class SectionEdges:
    """The two edges of the opening on a line across it.

    `states` (2,); `pixels` (2, 2) columns and rows; `bearings` (2, 3) unit vectors; `deviations` (2,), the
    standard deviation of each direction across the opening [rad]; `error` bounds the larger error [rad].
    Unknown numbers are NaN.
    """

    states: tuple[EdgeState, EdgeState] = (EdgeState.UNKNOWN, EdgeState.UNKNOWN)
    pixels: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 2), np.nan))
    bearings: npt.NDArray[np.float64] = field(default_factory=lambda: np.full((2, 3), np.nan))
    deviations: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    error: float = float("nan")

    @property
    def seen(self) -> bool:
        """Whether the image shows both edges."""
        return all(state is EdgeState.SEEN for state in self.states)


@dataclass(frozen=True)
class GapEdges:
    """The two points G0 and G1 in one image, and the edges beside them; the fields of knee_gap_msgs/GapEdges.

    `stamp_ns` is the exposure time [ns]; `frame_id` the optical frame of the lens. `track_id` is 0 without a
    track; the same id means the same two points. `bearings` (2, 3) are unit vectors, `pixels` (2, 2) columns
    and rows, `covariances` (2, 3, 3) those of the unit vectors [rad^2], and `angular_error` bounds the angle
    between each bearing and its true direction [rad]. `hidden` tells of each point that the image does not
    show it and it is only carried on; `pose_used` whether the pose of the lens guided the search.
    `camera_errors` (2, 3, k) are the displacements of the bearings by one standard deviation of each of the k
    independent errors of the camera's own numbers [rad]. `section` holds the edges of the opening where an
    instrument would pass, `sections` those at more places along it. Unknown numbers are NaN.
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
