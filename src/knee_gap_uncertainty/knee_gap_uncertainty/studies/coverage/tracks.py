"""Simulated tracks: a lens that travels past two points, and what a tracker and a camera report of it."""

from typing import NamedTuple

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.studies.coverage.cells import Cell, Scene

# The line of the gap leans this far out of the image plane, so that errors in depth enter the gap at first
# order.
LEAN = np.radians(20.0)
# Radii of the independent and of the common part of the image error, as shares of theta.
PARTS = {"independent": (1.0, 0.0), "half": (0.5, 0.5), "common": (0.0, 1.0)}


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
    bearings = true_bearings(lens, points)
    shape = (count, cell.view_count)
    own, common = PARTS[cell.share]
    image = own * errors.image_error * _disc((*shape, 2), bounded, rng)
    image += common * errors.image_error * _disc((count, 1, 2), bounded, rng)
    shifted = _turn(bearings, np.einsum("...a,...ak->...k", image, _image_axes(bearings)))
    rotation = errors.rotation_error * _ball(shape, bounded, rng)
    measured = shifted + np.cross(rotation[:, :, None], shifted)
    measured /= np.linalg.norm(measured, axis=-1, keepdims=True)
    deviation, lens_variance, rotation_variance = deviations(cell)
    return Tracks(
        lens=lens + errors.translation_error * _ball(shape, bounded, rng),
        bearings=measured,
        gap=cell.scene.gap,
        deviation=deviation,
        lens_variance=lens_variance,
        rotation_variance=rotation_variance,
    )


def true_bearings(lens: Array, points: Array) -> Array:
    """(N, 2, 3) unit vectors from the lens positions (N, 3) to the points (2, 3)."""
    towards = points - lens[:, None]
    return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def deviations(cell: Cell) -> tuple[float, float, float]:
    """Of each axis: deviation of a bearing [rad], variances of lens position [m^2] and rotation [rad^2]."""
    errors = cell.errors
    image = 0.5 * errors.image_error * float(np.hypot(*PARTS[cell.share]))
    return image, errors.translation_error**2 / 5.0, errors.rotation_error**2 / 5.0


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
