"""Simulated tracks on which the test for joint motion is measured: scopes in a hand, points that move."""

from dataclasses import dataclass
from math import radians, sqrt
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances

IMAGE_RATE = 60.0
TRAVEL = 8e-3
POINTS = np.array([[-2e-3, 0.0, 9.3e-3], [2e-3, 0.0, 10.7e-3]])
# Of the tracker: RMS length of its errors [m], [rad].
LENS_ERROR = 0.0367e-3
ROTATION_ERROR = radians(0.004)
TREMOR = 0.1e-3
TREMOR_HZ = (4.1, 5.3, 6.2)
# The scope turns about the portal by this while it travels, and trembles by that [rad].
TURN = 0.3
TURN_TREMOR = 0.02


@dataclass(frozen=True)
class Situation:
    """What is simulated.

    `travel`: "out", "out and back", "fast" (a third of the time, then rest) or "rest", all with hand tremor.
    `deviation`: standard deviation of a bearing per image axis [rad], of which `common_share` of the variance
    is common to the track. `event` happens half-way: "" nothing; "across", "along travel" and "along ray": G1
    moves by `size` [m] within `event_images` images and stays; "edge": its bearing jumps by `size` [rad] for
    `event_images` images.
    """

    travel: str = "out"
    deviation: float = radians(0.2)
    common_share: float = 0.0
    bounded: bool = False
    event: str = ""
    size: float = 0.0
    event_images: int = 1


class Track(NamedTuple):
    """Views in the order of time, and the image at which the event begins (their number where none does)."""

    views: Views
    event_at: int


def simulate(situation: Situation, image_count: int, rng: np.random.Generator) -> Track:
    """Draw one track."""
    lens, rotations, along = _path(situation.travel, image_count, rng)
    event_at = image_count // 2 if situation.event else image_count
    points = np.tile(POINTS, (image_count, 1, 1))
    progress = np.clip((np.arange(image_count) - event_at + 1) / situation.event_images, 0.0, 1.0)
    across = np.cross([0.0, 0.0, 1.0], along)
    directions = {
        "across": across / np.linalg.norm(across),
        "along travel": along,
        "along ray": POINTS[1] / np.linalg.norm(POINTS[1]),
    }
    if situation.event in directions:
        points[:, 1] += situation.size * progress[:, None] * directions[situation.event]
    towards = np.einsum("nji,npj->npi", rotations, points - lens[:, None])
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    offsets = sqrt(situation.common_share) * _noise((1, 2, 2), situation.bounded, rng)
    offsets = offsets + sqrt(1.0 - situation.common_share) * _noise(
        (image_count, 2, 2), situation.bounded, rng
    )
    offsets *= situation.deviation
    if situation.event == "edge":
        angle = 2.0 * np.pi * rng.random()
        jumped = slice(event_at, event_at + situation.event_images)
        offsets[jumped, 1] += situation.size * np.array([np.cos(angle), np.sin(angle)])
    seen = bearings + np.einsum("npa,npak->npk", offsets, _image_axes(bearings))
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    lens_seen = lens + LENS_ERROR / sqrt(3.0) * rng.standard_normal((image_count, 3))
    turned = Rotation.from_rotvec(ROTATION_ERROR / sqrt(3.0) * rng.standard_normal((image_count, 3)))
    rotations_seen = turned.as_matrix() @ rotations
    seen = np.einsum("nij,npj->npi", rotations_seen, seen)
    return Track(
        Views(
            lens_seen,
            seen,
            bearing_covariances(seen, situation.deviation),
            isotropic_covariances(image_count, LENS_ERROR),
            isotropic_covariances(image_count, ROTATION_ERROR),
            lens_rotations=rotations_seen,
            times=np.arange(image_count) / 60.0,
        ),
        event_at,
    )


def _path(travel: str, image_count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Lens positions (N, 3) [m], rotations (N, 3, 3) lens to points, direction of the travel (3,)."""
    share = np.linspace(0.0, 1.0, image_count)
    done = {
        "out": share,
        "out and back": 1.0 - np.abs(2.0 * share - 1.0),
        "fast": np.minimum(1.0, 3.0 * share),
        "rest": 0.0 * share,
    }[travel]
    along = rng.standard_normal(3) * [1.0, 1.0, 0.3]
    along /= np.linalg.norm(along)
    time = np.arange(image_count)[:, None] / IMAGE_RATE
    phases = 2.0 * np.pi * (time * TREMOR_HZ + rng.random(3))
    lens = TRAVEL * done[:, None] * along + TREMOR * np.sin(phases)
    turns = TURN * done[:, None] * np.cross(along, [0.0, 0.0, 1.0]) + TURN_TREMOR * np.cos(phases)
    return lens, Rotation.from_rotvec(turns).as_matrix(), along


def _noise(shape: tuple[int, ...], bounded: bool, rng: np.random.Generator) -> Array:
    """(*shape) with two image axes last, variance 1 in each: even in a disc, or Gaussian."""
    if not bounded:
        return rng.standard_normal(shape)
    radius = 2.0 * np.sqrt(rng.random(shape[:-1]))
    angle = 2.0 * np.pi * rng.random(shape[:-1])
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _image_axes(bearings: Array) -> Array:
    """(..., 2, 3) image axes x and y, carried from the optical axis z to each bearing."""
    middle = bearings + np.array([0.0, 0.0, 1.0])
    along = bearings[..., :2, None] / (1.0 + bearings[..., 2, None, None])
    return np.asarray(np.eye(3)[:2] - along * middle[..., None, :])
