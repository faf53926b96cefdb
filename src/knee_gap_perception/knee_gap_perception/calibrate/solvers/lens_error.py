"""Bounds of the lens pose errors in two views, due to calibration and tracker, for `gap_range`."""

from typing import Protocol

import numpy as np

from knee_gap_core.values.arrays import Array

COVERAGE_FACTOR = 3.0  # standard deviations of a bound


class LensError(Protocol):
    """Interface of the lens on its body: `calibration_file.LensOnBody` and `hand_eye.HandEye`."""

    @property
    def T_body_lens(self) -> Array:  # noqa: N802 - frames are in the name
        """The lens on its body (4, 4)."""

    @property
    def covariance(self) -> Array:
        """Covariance of the twist of T_body_lens (6, 6), rotation first."""

    @property
    def rotation_error(self) -> float:
        """RMS error of the tracked body [rad]."""

    @property
    def translation_error(self) -> float:
        """RMS error of the tracked body [m]."""


def lens_covariance(T_world_body_0: Array, T_world_body_1: Array, lens: LensError) -> tuple[Array, Array]:
    """Covariances (3, 3) of the lens position [m^2] and rotation [rad^2] in the world, for two views.

    The part of the calibration's error that both views share moves the triangle as a whole and is left out.
    Of the lens's position on the body only (R_1 - R_0) has an effect, half of it at each view. Its rotation
    counts in full.
    """
    per_axis = np.array([lens.rotation_error, lens.translation_error]) ** 2 / 3
    arm = T_world_body_1[:3, :3] @ lens.T_body_lens[:3, 3]
    lever = float(arm @ arm) * np.eye(3) - np.outer(arm, arm)
    tracker_position = per_axis[1] * np.eye(3) + per_axis[0] * lever
    R_0, R_1 = (T[:3, :3] @ lens.T_body_lens[:3, :3] for T in (T_world_body_0, T_world_body_1))
    felt = (R_1 - R_0) / 2
    position = tracker_position + felt @ lens.covariance[3:, 3:] @ felt.T
    rotation = per_axis[0] * np.eye(3) + R_1 @ lens.covariance[:3, :3] @ R_1.T
    return position, rotation


def lens_errors(
    T_world_body_0: Array, T_world_body_1: Array, lens: LensError, *, coverage_factor: float = COVERAGE_FACTOR
) -> tuple[float, float]:
    """Bounds of the error of a lens position [m] and of its rotation [rad], for two views of a tracked body.

    They are `coverage_factor` standard deviations along the worst direction; the error of the image itself
    is to be added to the second.
    """
    position, rotation = lens_covariance(T_world_body_0, T_world_body_1, lens)
    worst = [float(np.sqrt(np.linalg.eigvalsh(matrix)[-1])) for matrix in (position, rotation)]
    return coverage_factor * worst[0], coverage_factor * worst[1]
