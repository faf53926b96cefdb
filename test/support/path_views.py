"""Views of two points from a straight path of the lens, exact or with errors."""

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances

Floats = npt.NDArray[np.float64]

POINTS = np.array([[-0.002, 0.0003, 0.010], [0.002, -0.0002, 0.0112]])
DEVIATION = 0.01
LENS_RMS = 3.67e-5
ROTATION_RMS = 2e-4


def directions(lens: Floats, points: Floats = POINTS) -> Floats:
    towards = points - lens[:, None]
    return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def lens_path(count: int, travel: float = 0.004) -> Floats:
    along = np.linspace(-0.5, 0.5, count)[:, None] * travel
    return np.asarray(along * [0.8, 0.6, 0.0] + 0.1 * along**2 / travel * [0.0, 0.0, 1.0])


def views_of(
    lens: Floats, bearings: Floats, deviation: float = DEVIATION, share: float = 0.0, **others: Floats
) -> Views:
    given = {
        "bearing_covariances": bearing_covariances(bearings, deviation),
        "lens_covariances": isotropic_covariances(len(lens), LENS_RMS),
        "rotation_covariances": isotropic_covariances(len(lens), ROTATION_RMS),
        **others,
    }
    return Views(lens, bearings, common_share=share, **given)


def noisy(rng: np.random.Generator, count: int, deviation: float = DEVIATION, share: float = 0.0) -> Views:
    """Views of the path with errors as large as stated."""
    lens = lens_path(count)
    bearings = directions(lens)
    side = np.cross(bearings, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    frames = np.stack([side, np.cross(bearings, side)], axis=-2)
    image = np.sqrt(1.0 - share) * rng.standard_normal((count, 2, 2))
    image += np.sqrt(share) * rng.standard_normal((1, 2, 2))
    bearings = bearings + deviation * np.einsum("ina,inak->ink", image, frames)
    turn = rng.standard_normal((count, 1, 3)) * ROTATION_RMS / np.sqrt(3.0)
    bearings = bearings + np.cross(turn, bearings)
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    return views_of(
        lens + rng.standard_normal((count, 3)) * LENS_RMS / np.sqrt(3.0), bearings, deviation, share
    )
