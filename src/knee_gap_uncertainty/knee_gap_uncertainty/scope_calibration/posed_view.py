"""One image's edges with the lens pose at its stamp: a view of the two points in the frame of the poses."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.quaternions import matrix, unit_quaternion
from knee_gap_uncertainty.multi_view.views import Views

Floats = npt.NDArray[np.float64]


class PosedView(NamedTuple):
    """Where the lens was (3,) [m], where it saw the points (2, 3), and the bounds of both errors.

    `angular_error` is psi = theta + omega [rad], `translation_error` DT [m]; `view` carries the same with
    covariances in the place of bounds.
    """

    stamp_ns: int
    lens: Floats
    bearings: Floats
    angular_error: float
    translation_error: float
    view: Views


def posed_view(edges: GapEdges, pose: LensPose, tracker_bound: float, camera_error: float = 0.0) -> PosedView:
    """View of `edges` from `pose`; tracked errors are bounded by `tracker_bound` times their RMS length.

    `camera_error` [-] is the relative standard error of a focal length that was not calibrated; it comes to
    the errors of the camera that the edges state. Raises BadInputError for matrices that are not covariances.
    """
    rotation = matrix(unit_quaternion(pose.quaternion_xyzw))
    bearings = edges.bearings @ rotation.T
    translation, turn = pose.covariance[:3, :3], pose.covariance[3:, 3:]
    return PosedView(
        stamp_ns=edges.stamp_ns,
        lens=pose.position,
        bearings=bearings,
        angular_error=edges.angular_error + tracker_bound * float(np.sqrt(np.trace(turn))),
        translation_error=tracker_bound * float(np.sqrt(np.trace(translation))),
        view=Views(
            lens_positions=pose.position[None],
            bearings=bearings[None],
            bearing_covariances=(rotation @ edges.covariances @ rotation.T)[None],
            lens_covariances=translation[None],
            rotation_covariances=turn[None],
            lens_rotations=rotation[None],
            lens_motions=np.nan_to_num(pose.motion)[None],
            motion_times=np.array([pose.motion_time]),
            scope_rotations=np.array([pose.scope_rotation]),
            camera_errors=(rotation @ _camera_errors(edges, camera_error))[None],
            times=np.array([1e-9 * edges.stamp_ns]),
        ),
    )


def _camera_errors(edges: GapEdges, camera_error: float) -> Floats:
    """(2, 3, k) what the edges state, and the displacement by a focal length that is wrong by a share.

    A bearing at an angle from the axis of the picture goes away from it by that share of the angle.
    """
    if not camera_error > 0.0:
        return edges.camera_errors
    x, y, z = edges.bearings.T
    across = np.hypot(x, y)
    angle, size = np.arctan2(across, z), np.maximum(across, np.finfo(float).tiny)
    outward = np.column_stack([x * z / size, y * z / size, -across])
    return np.concatenate(
        [edges.camera_errors, camera_error * (angle[:, None] * outward)[..., None]], axis=-1
    )
