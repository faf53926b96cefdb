"""The simulated optical tracker: reported poses of the scope, at 120 Hz and with errors."""

from dataclasses import dataclass

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse
from knee_gap_simulation.errors import SimulationError


@dataclass(frozen=True)
class TrackerNoise:
    """Errors of the tracked lens pose: RMS lengths of the error vectors (Table 3 of the paper).

    ``translation_error`` [m] and ``rotation_error`` [rad] are Gaussian on each axis, independent between
    samples, with a variance of RMS^2 / 3 per axis.
    """

    translation_error: float = 0.0367e-3
    rotation_error: float = np.radians(0.004)

    def __post_init__(self) -> None:
        for name in ("translation_error", "rotation_error"):
            if not 0.0 <= getattr(self, name) < 0.1:
                raise SimulationError(f"{name} must lie in [0, 0.1) (m, rad), not {getattr(self, name)}")


def tracked_body(
    T_world_lens: Array, T_body_lens: Array, noise: TrackerNoise, rng: np.random.Generator
) -> Array:
    """Body poses ``T_world_body`` (n, 4, 4) as the tracker reports them for true lens poses (n, 4, 4).

    The paper states the error at the lens. An independent rotation error of 0.004 degrees on a lever of
    0.2 m would alone move the lens by another 0.014 mm. So the noise is added to the *lens* pose, and that
    pose is transformed to the body. The lens position computed from the reported body pose and the true
    transform then has an RMS error of exactly ``translation_error``, whatever the lever.
    """
    count = len(T_world_lens)
    sigma = np.array([noise.translation_error, noise.rotation_error]) / np.sqrt(3.0)
    shift = sigma[0] * rng.standard_normal((count, 3))
    turn = sigma[1] * rng.standard_normal((count, 3))
    noisy = T_world_lens @ from_rotation_vectors(turn, np.zeros((count, 3)))
    noisy[:, :3, 3] += shift
    return noisy @ inverse(T_body_lens)


def track_lens(
    T_world_lens: Array, T_body_lens: Array, seed: int, noise: TrackerNoise | None = None
) -> Array:
    """Reported body poses (n, 4, 4) for true lens poses, with noise drawn from a seed."""
    rng = np.random.default_rng([seed, 0x5452])
    return tracked_body(T_world_lens, T_body_lens, noise or TrackerNoise(), rng)


def world_from_scene(seed: int) -> Array:
    """``T_world_scene`` (4, 4): a knee at a random pose in the tracker's volume."""
    rng = np.random.default_rng([seed, 0x574F])
    return from_rotation_vectors(rng.uniform(-1.2, 1.2, 3), rng.uniform([-0.5, 0.8, -0.5], [0.5, 1.2, 0.5]))
