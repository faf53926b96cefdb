"""One image's edges with the lens pose at its stamp: a view of the two points in the frame of the poses."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_uncertainty.gap_estimate import EdgeObservation
from knee_gap_uncertainty.pose_buffer import LensPose
from knee_gap_uncertainty.views import Views

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


def posed_view(edges: EdgeObservation, pose: LensPose, tracker_bound: float) -> PosedView:
    """View of `edges` from `pose`; tracked errors are bounded by `tracker_bound` times their RMS length.

    Raises BadInputError for covariances that are none.
    """
    rotation = Rotation.from_quat(pose.quaternion_xyzw)
    matrix = rotation.as_matrix()
    bearings = edges.bearings @ matrix.T
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
            bearing_covariances=(matrix @ edges.covariances @ matrix.T)[None],
            lens_covariances=translation[None],
            rotation_covariances=turn[None],
            lens_rotations=matrix[None],
            lens_motions=np.nan_to_num(pose.motion)[None],
            motion_times=np.array([pose.motion_time]),
            scope_turns=np.array([pose.scope_turn]),
            camera_errors=(matrix @ edges.camera_errors)[None],
        ),
    )
