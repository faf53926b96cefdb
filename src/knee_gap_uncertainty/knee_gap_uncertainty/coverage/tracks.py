"""Simulated tracks: a lens that travels past two points, and what a tracker and a camera report of it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_uncertainty.coverage.cells import SHARES, Cell, Scene

Array = npt.NDArray[np.float64]

# The line of the gap leans this far out of the image plane, so that errors in depth enter the gap at first
# order.
LEAN = np.radians(20.0)


class Tracks(NamedTuple):
    """`count` tracks of one cell: lens positions (R, N, 3) [m], bearings (R, N, 2, 3), the true gap [m].

    `deviation`: standard deviation of a bearing in each image axis [rad]; `lens_variance` [m^2] and
    `rotation_variance` [rad^2] of each component: what was simulated.
    """

    lens: Array
    bearings: Array
    gap: float
    deviation: float
    lens_variance: float
    rotation_variance: float


def true_track(scene: Scene, view_count: int) -> tuple[Array, Array]:
    """Lens positions (N, 3) and points (2, 3) [m]; the lens looks along z and travels evenly across it."""
    angle = np.radians(scene.direction_deg)
    along = np.array([np.sin(angle), np.cos(angle), 0.0])
    lens = np.linspace(-0.5, 0.5, view_count)[:, None] * scene.travel * along
    half = 0.5 * scene.gap * np.array([np.cos(LEAN), 0.0, np.sin(LEAN)])
    middle = np.array([0.0, 0.0, scene.depth])
    return lens, np.stack([middle - half, middle + half])


def simulate(cell: Cell, count: int, rng: np.random.Generator) -> Tracks:
    """Draw tracks with the errors of the cell.

    Bounded noise is even in the disc of radius theta (image), the ball of radius DT (lens position) and the
    ball of radius omega (rotation). Where half is common, the common and the independent part have half the
    radius each, so that their sum keeps the bound. Gaussian noise has the same variances.
    """
    errors, bounded = cell.errors, cell.noise == "bounded"
    lens, points = true_track(cell.scene, cell.view_count)
    towards = points - lens[:, None]
    true_bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    shape = (count, cell.view_count)

    share = SHARES[cell.share]
    parts = {0.0: (1.0, 0.0), 0.5: (0.5, 0.5), 1.0: (0.0, 1.0)}[share]
    image = parts[0] * errors.image_error * _disc((*shape, 2), bounded, rng)
    image += parts[1] * errors.image_error * _disc((count, 1, 2), bounded, rng)
    axes = _image_axes(true_bearings)
    shifted = _turn(true_bearings, np.einsum("...a,...ak->...k", image, axes))
    rotation = errors.rotation_error * _ball(shape, bounded, rng)
    bearings = shifted + np.cross(rotation[:, :, None], shifted)
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    return Tracks(
        lens=lens + errors.translation_error * _ball(shape, bounded, rng),
        bearings=bearings,
        gap=cell.scene.gap,
        deviation=0.5 * errors.image_error * float(np.hypot(*parts)),
        lens_variance=errors.translation_error**2 / 5.0,
        rotation_variance=errors.rotation_error**2 / 5.0,
    )


def _disc(shape: tuple[int, ...], bounded: bool, rng: np.random.Generator) -> Array:
    """(*shape, 2) even in the unit disc, or Gaussian with the same variance, 1/4 in each axis."""
    if not bounded:
        return 0.5 * rng.standard_normal((*shape, 2))
    radius, angle = np.sqrt(rng.random(shape)), 2.0 * np.pi * rng.random(shape)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _ball(shape: tuple[int, ...], bounded: bool, rng: np.random.Generator) -> Array:
    """(*shape, 3) even in the unit ball, or Gaussian with the same variance, 1/5 in each axis."""
    normal = rng.standard_normal((*shape, 3))
    if not bounded:
        return np.asarray(np.sqrt(0.2) * normal)
    radius = np.cbrt(rng.random(shape))
    return np.asarray(normal * (radius / np.linalg.norm(normal, axis=-1))[..., None])


def _image_axes(bearings: Array) -> Array:
    """(..., 2, 3) axes of the image, x and y, carried from the optical axis z to each bearing."""
    axes = np.zeros((*bearings.shape[:-1], 2, 3))
    middle = bearings + np.array([0.0, 0.0, 1.0])
    for axis in range(2):
        unit = np.eye(3)[axis]
        axes[..., axis, :] = unit - bearings[..., axis, None] / (1.0 + bearings[..., 2, None]) * middle
    return axes


def _turn(bearings: Array, tangents: Array) -> Array:
    """Bearings moved along a great circle by tangent vectors [rad]."""
    angle = np.linalg.norm(tangents, axis=-1, keepdims=True)
    return np.asarray(np.cos(angle) * bearings + np.sinc(angle / np.pi) * tangents)
