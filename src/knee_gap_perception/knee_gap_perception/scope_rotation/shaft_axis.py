"""Motion of the lens of an oblique scope that is turned in its camera head.

The relay of lenses carries the picture of the tip to the sensor, so a turn of the scope by an angle turns the
picture, notch and all, by the same angle (clockwise on the screen where the scope turns clockwise as seen
along the view). Intrinsics belong to the sensor: the picture is taken to turn about the principal point.

Body on the camera head: the tip turns about the shaft, T_body_lens(turn) = S(turn) T_body_lens(0) Rz(-turn),
with S the rotation about the shaft's axis. Body on the scope: only the picture turns,
T_body_lens(turn) = T_body_lens(0) Rz(-turn). In both, `arthroscope_optical` keeps its x and y along the
image's (Yamaguchi et al. 2004; Wu and Jaramaz 2008).
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import rigid, skew
from knee_gap_perception.errors import PerceptionError


class Mount(StrEnum):
    """What the tracked body is fixed to."""

    CAMERA_HEAD = "camera_head"
    SCOPE = "scope"


@dataclass(frozen=True)
class ShaftAxis:
    """The axis that the scope turns about in its camera head, in the body's frame.

    `direction` (3,) is a unit vector towards the tip, `point` (3,) [m] any point of the axis.
    """

    direction: Array
    point: Array

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.direction))
        if not np.isclose(length, 1.0, atol=1e-6):
            raise PerceptionError(f"the shaft's direction must be a unit vector, not of length {length}")

    def turned(self, turn: float) -> Array:
        """S (4, 4), the rotation about the axis by an angle [rad]."""
        R = about(self.direction, turn)
        return rigid(R, self.point - R @ self.point)


def about(direction: npt.ArrayLike, angle: float) -> Array:
    """Rotation matrix (3, 3) about a unit vector (3,) by an angle [rad] (Rodrigues)."""
    d = np.asarray(direction, dtype=np.float64)
    R: Array = np.eye(3) * np.cos(angle) + np.sin(angle) * skew(d) + (1 - np.cos(angle)) * np.outer(d, d)
    return R


def roll(turn: float) -> Array:
    """The transform (4, 4) that turns the picture by an angle [rad] about the view."""
    return rigid(about([0.0, 0.0, 1.0], turn), np.zeros(3))


def rotated_lens(T_body_lens: npt.ArrayLike, turn: float, mount: Mount, axis: ShaftAxis | None) -> Array:
    """`T_body_lens` (4, 4) when the scope is turned by an angle [rad] from where it was calibrated.

    Raises PerceptionError for an angle that is not known, and for a body on the camera head whose axis is
    not.
    """
    if not np.isfinite(turn):
        raise PerceptionError("the turn of the scope in its camera head is not known")
    lens = np.asarray(T_body_lens, dtype=np.float64) @ roll(-turn)
    if mount is Mount.SCOPE:
        return np.asarray(lens)
    if axis is None:
        if turn == 0.0:
            return np.asarray(lens)
        raise PerceptionError("the shaft's axis is not calibrated: a turned scope cannot be corrected for")
    return np.asarray(axis.turned(turn) @ lens)


def rotation_between(
    T_head_scope_0: npt.ArrayLike, T_head_scope: npt.ArrayLike, direction: npt.ArrayLike
) -> float:
    """Turn [rad] of a second tracked body on the scope against the one on the camera head.

    It is the rotation from the calibrated relative pose to the present one, about `direction` in the head's
    frame.
    """
    R = np.asarray(T_head_scope)[:3, :3] @ np.asarray(T_head_scope_0)[:3, :3].T
    d = np.asarray(direction, dtype=np.float64)
    # The rotation about d that is nearest to R in the Frobenius norm (swing-twist).
    sine = float(d @ [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    cosine = float(np.trace(R) - d @ R @ d)
    return float(np.arctan2(sine, cosine))


def shaft_axis(T_head_scope: npt.ArrayLike) -> tuple[ShaftAxis, float]:
    """The axis, in the head's frame, about which poses (n, 4, 4) of a body on the scope turn.

    Returns it with the largest turn between two of the poses [rad]. Its direction is unsigned by nature; it
    is returned with a positive z. Raises PerceptionError where the turn is below 30 degrees.
    """
    T = np.asarray(T_head_scope, dtype=np.float64)
    R, t = T[:, :3, :3], T[:, :3, 3]
    relative = R @ R[0].T
    spread = float(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)).max())
    if spread < np.radians(30):
        raise PerceptionError(
            f"the scope turns by {np.degrees(spread):.1f} deg in its camera head; at least 30 deg are "
            "needed: turn "
            "the light post slowly from one side to the other"
        )
    # All rotations leave the direction alone: it spans the null space of the stacked R_i - I; a point of the
    # axis goes nowhere: (I - R_i) c = t_i - R_i t_0.
    stacked = np.eye(3) - relative
    direction = np.linalg.svd(stacked.reshape(-1, 3))[2][2]
    direction = direction if direction[2] >= 0 else -direction
    moved = t - relative @ t[0]
    point = np.linalg.lstsq(
        np.concatenate([stacked.reshape(-1, 3), direction[None]]),
        np.concatenate([moved.ravel(), [0.0]]),
        rcond=None,
    )[0]
    return ShaftAxis(direction, point), spread
