"""The leg as reference: the pose of the lens in the frame of a tracked body on the leg."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose, LensPose
from knee_gap_core.values.rigid_transforms import skew


def relative_to(lens: LensPose, reference: BodyPose, covariance: Array) -> LensPose:
    """Return the lens pose in the frame of `reference`, which is named after the body.

    `covariance` (6, 6) is that of the reference's pose, in the order and frame of the lens pose's own; both
    errors are taken as independent. With p = R^T (p_lens - p_reference), a small rotation r of the reference
    about the fixed axes moves p by R^T ((p_lens - p_reference) x r), and turns the result by -R^T r.
    """
    R_world_reference = Rotation.from_quat(reference.quaternion_xyzw)
    R_reference_world = R_world_reference.inv()
    lever = lens.position - reference.position
    to_reference = np.kron(np.eye(2), R_reference_world.as_matrix())
    by_reference = -np.eye(6)
    by_reference[:3, 3:] = skew(lever)
    by_reference = to_reference @ by_reference
    turned = R_reference_world * Rotation.from_quat(lens.quaternion_xyzw)
    return replace(
        lens,
        frame_id=reference.name,
        position=R_reference_world.apply(lever),
        quaternion_xyzw=turned.as_quat(canonical=True),
        covariance=np.asarray(
            to_reference @ lens.covariance @ to_reference.T + by_reference @ covariance @ by_reference.T
        ),
    )
