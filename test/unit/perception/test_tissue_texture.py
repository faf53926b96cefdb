"""How much texture there is at a place: how well a patch measures; debris counts for little of it."""

import cv2
import numpy as np
import pytest

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.point_tracking.texture import TissueTexture

CENTRE, HALF = np.array([128.0, 128.0]), 24


def _tissue(rng: np.random.Generator, contrast: float) -> np.ndarray:
    """Brightness (256, 256) of a surface with a texture of a few pixels."""
    detail = cv2.GaussianBlur(rng.standard_normal((256, 256)), (0, 0), 3.0)
    return 120.0 + contrast * detail / detail.std() + rng.standard_normal((256, 256))


def _taken(brightness: np.ndarray) -> TissueTexture:
    return TissueTexture(np.clip(brightness, 0, 255).astype(np.uint8), CENTRE, 40.0, HALF, 30.0)


def _weakest(texture: TissueTexture, pixel: np.ndarray, limit: float = float("inf")) -> float:
    return float(np.linalg.eigvalsh(texture.information(pixel, limit)[0])[0])


def test_one_spot_of_dark_debris_is_not_taken_for_texture_to_follow():
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[:256, :256]
    spot = 60.0 * np.exp(-((columns - 118.0) ** 2 + (rows - 118.0) ** 2) / (2 * 2.5**2))
    share = [
        _weakest(tissue, CENTRE, 1.5) / _weakest(tissue, CENTRE)
        for tissue in (_taken(_tissue(rng, 12.0)), _taken(_tissue(rng, 1.0) - spot))
    ]
    assert share[1] < 0.9 * share[0]


def test_lines_tell_of_a_shift_across_them_only():
    lines = 120.0 + 12.0 * np.sin(np.arange(256) / 3.0)[:, None] * np.ones(256)
    information, _ = _taken(lines).information(CENTRE)
    assert information[1, 1] > 100.0 * information[0, 0]
    assert abs(information[0, 1]) < 0.01 * information[1, 1]


def test_slanted_lines_tell_of_a_shift_across_them_only():
    rows, columns = np.mgrid[:256, :256]
    lines = 120.0 + 12.0 * np.sin((rows * np.cos(0.5) + columns * np.sin(0.5)) / 3.0)
    information, _ = _taken(lines).information(CENTRE)
    values, axes = np.linalg.eigh(information)
    assert values[1] > 50.0 * values[0]
    assert abs(axes[:, 1] @ [np.sin(0.5), np.cos(0.5)]) > 0.999


def test_a_place_beside_the_gap_has_less_tissue_than_one_amid_it():
    tissue = _tissue(np.random.default_rng(2), 12.0)
    tissue[150:] = 5.0
    texture = _taken(tissue)
    shares = [texture.information(CENTRE + np.array([0.0, away]))[1] for away in (-30.0, 0.0, 30.0)]
    assert shares[0] > 0.9
    assert shares[0] > shares[1] > shares[2]


@pytest.mark.parametrize("pixel", [CENTRE - 40.0, CENTRE + 40.0])
def test_the_farthest_places_are_whole(pixel):
    information, share = _taken(_tissue(np.random.default_rng(3), 12.0)).information(pixel)
    assert share > 0.95
    assert np.isfinite(information).all()


@pytest.mark.parametrize("away", [60.0, np.nan, np.inf])
def test_a_place_outside_is_refused(away):
    texture = _taken(_tissue(np.random.default_rng(3), 12.0))
    with pytest.raises(PerceptionError, match="outside the square"):
        texture.information(CENTRE + np.array([away, 0.0]))
