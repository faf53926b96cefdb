"""How a patch of surface is found again: where it is, and that its covariance is as large as its error."""

import cv2
import numpy as np
import pytest

from knee_gap_perception.point_tracking.patch_registration import Patch, Warp, surface_around
from knee_gap_perception.point_tracking.point_tracker import REGISTRATION_FLOOR

HALF, CENTRE = 32, np.array([128.0, 128.0])
WIDE_PRIOR = np.diag([16.0, 16.0, 1e-4, 1e-4, 1e-4, 1e-4])


def _speckle(rng: np.random.Generator, contrast: float) -> np.ndarray:
    """Brightness (256, 256) of a surface with a texture of a few pixels."""
    detail = cv2.GaussianBlur(rng.standard_normal((256, 256)), (0, 0), 3.0)
    return 120.0 + contrast * detail / detail.std()


def _line() -> np.ndarray:
    """A vessel that crosses an even surface straight, 35 degrees from the rows."""
    rows, columns = np.mgrid[:256, :256] - 128.0
    away = np.cos(np.radians(35)) * rows - np.sin(np.radians(35)) * columns
    return 120.0 - 25.0 * np.exp(-(away**2) / (2 * 2.5**2))


def _seen(surface: np.ndarray, shift: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    moved = cv2.warpAffine(surface, matrix, (256, 256), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.rint(moved + noise * rng.standard_normal(moved.shape)), 0, 255).astype(np.uint8)


def _patch(image: np.ndarray) -> Patch:
    return Patch(surface_around(image, CENTRE, 64, 30), CENTRE, HALF)


def _find(patch: Patch, image: np.ndarray, start: np.ndarray):
    surface = surface_around(image, CENTRE, 64, 30)
    return patch.find(surface, Warp(CENTRE + start, np.eye(2)), WIDE_PRIOR)


def test_textured_patch_is_found_to_a_fraction_of_a_pixel():
    rng = np.random.default_rng(1)
    surface, shift = _speckle(rng, 12.0), np.array([1.7, -0.9])
    found = _find(_patch(_seen(surface, np.zeros(2), 1.0, rng)), _seen(surface, shift, 1.0, rng), np.zeros(2))
    assert found.converged
    assert np.abs(found.warp.position - CENTRE - shift).max() < 0.1
    assert np.sqrt(found.covariance[0, 0]) < 0.3


def test_along_a_lone_line_nothing_is_known():
    """Noise has gradients along the line as well; they must not pass for knowledge."""
    rng = np.random.default_rng(2)
    surface = _line()
    found = _find(
        _patch(_seen(surface, np.zeros(2), 2.0, rng)), _seen(surface, np.zeros(2), 2.0, rng), np.zeros(2)
    )
    along = np.array([np.cos(np.radians(35)), np.sin(np.radians(35))])
    across = np.array([-along[1], along[0]])
    position = found.covariance[:2, :2]
    assert np.sqrt(along @ position @ along) > 0.4 * 4.0
    assert np.sqrt(across @ position @ across) < 1.0


def test_two_pictures_of_nothing_but_noise_tell_nothing():
    rng = np.random.default_rng(3)
    even = np.full((256, 256), 120.0)
    found = _find(_patch(_seen(even, np.zeros(2), 3.0, rng)), _seen(even, np.zeros(2), 3.0, rng), np.zeros(2))
    assert np.sqrt(np.linalg.eigvalsh(found.covariance[:2, :2])[0]) > 0.8 * 4.0


@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_errors_are_not_larger_than_the_covariance_says(noise):
    """As it is used, with the floor: over 60 surfaces the squared errors exceed it only as chance allows."""
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(60):
        surface, shift = _speckle(rng, 8.0), rng.uniform(-2.0, 2.0, 2)
        patch = _patch(_seen(surface, np.zeros(2), noise, rng))
        found = _find(patch, _seen(surface, shift, noise, rng), np.zeros(2))
        error = found.warp.position - CENTRE - shift
        covariance = found.covariance[:2, :2] + REGISTRATION_FLOOR**2 * np.eye(2)
        squares.append(float(error @ np.linalg.solve(covariance, error)) / 2)
    assert np.mean(squares) < 1.3


def _edge_of_bone(zoom: float, rng: np.random.Generator) -> np.ndarray:
    """Bone that darkens towards the gap below it, 14 px under its point, seen `zoom` times as large."""
    detail = cv2.GaussianBlur(np.random.default_rng(7).standard_normal((256, 256)), (0, 0), 3.0)
    depth = np.arange(256)[:, None] - 142.0
    shade = np.sqrt(np.clip(-depth / 40.0, 0.0, 1.0))
    bone = 160.0 * shade * (1.0 + 0.03 * detail / detail.std())
    whole = np.where(depth < 0, np.maximum(bone, 12.0), 12.0)
    matrix = np.array([[zoom, 0.0, 128.0 * (1 - zoom)], [0.0, zoom, 128.0 * (1 - zoom)]])
    seen = cv2.warpAffine(whole, matrix, (256, 256), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.rint(seen + rng.standard_normal(seen.shape)), 0, 255).astype(np.uint8)


def test_shading_beside_an_edge_holds_a_patch_back_less_through_a_window_that_grows_with_the_picture():
    zoom, errors = 1.2, np.zeros((4, 2))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        patch, larger = _patch(_edge_of_bone(1.0, rng)), _edge_of_bone(zoom, rng)
        for k, stretch in enumerate((zoom, 1.0)):
            surface = surface_around(larger, CENTRE, 64, 30, stretch=(stretch, stretch))
            found = patch.find(surface, Warp(CENTRE, zoom * np.eye(2)), WIDE_PRIOR)
            errors[seed, k] = np.linalg.norm(found.warp.position - CENTRE)
    assert errors[:, 0].max() < 0.4
    assert errors[:, 0].mean() < 0.5 * errors[:, 1].mean()


def _shred(place: np.ndarray) -> np.ndarray:
    """Light (256, 256) that a small piece of something pale adds where it drifts by."""
    rows, columns = np.mgrid[:256, :256]
    return 60.0 * np.exp(-((columns - place[0]) ** 2 + (rows - place[1]) ** 2) / (2 * 2.5**2))


def test_a_pale_shred_that_drifts_by_does_not_carry_the_patch_away():
    """The surface stands still, all but even; a shred moves on by 5 px, and the search begins between."""
    rng = np.random.default_rng(2)
    surface, place = _speckle(rng, 0.5), CENTRE + np.array([6.0, 3.0])
    patch = _patch(_seen(surface + _shred(place), np.zeros(2), 1.0, rng))
    image = _seen(surface + _shred(place + np.array([5.0, 0.0])), np.zeros(2), 1.0, rng)
    found = _find(patch, image, np.array([2.0, 0.0]))
    assert np.abs(found.warp.position - CENTRE).max() < 1.0
