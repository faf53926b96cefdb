"""The drawn joint, and the pictures of a scope that travels along it."""

import cv2
import numpy as np
import pytest
from drawn_joint import Joint, joint

from knee_gap_core.values.arrays import Array, Image

__all__ = ["joint", "travel"]


@pytest.fixture(scope="session")
def travel(joint: Joint) -> tuple[list[Array], list[Image]]:
    """Poses (4, 4) and pictures of 6 mm along the gap in 30 images, with a tremor."""
    rng = np.random.default_rng(8)
    poses = []
    for share in np.linspace(0.0, 1.0, 30):
        T = np.eye(4)
        T[:3, 3] = [6e-3 * (3 * share**2 - 2 * share**3), 2e-4 * np.sin(9 * share), -3e-4 * np.sin(5 * share)]
        T[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.002, 3))[0]
        poses.append(T)
    return poses, [joint.picture(T, seed) for seed, T in enumerate(poses)]
