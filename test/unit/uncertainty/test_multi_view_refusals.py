"""Views that a fit over all views refuses, and what it answers at the borders of what it can."""

import numpy as np
import pytest
from path_views import (
    DEVIATION,
    LENS_RMS,
    directions,
    lens_path,
    noisy,
    views_of,
)

from knee_gap_core.values.errors import BadInputError, BaselineTooShortError
from knee_gap_uncertainty.multi_view.confidence_interval import confidence_interval
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit
from knee_gap_uncertainty.multi_view.views import bearing_covariances, isotropic_covariances


def test_one_view_and_views_from_one_place_are_refused() -> None:
    lens = lens_path(3)
    with pytest.raises(BadInputError, match="at least 2 views are needed to measure depth, not 1"):
        fit(views_of(lens[:1], directions(lens[:1])))
    still = np.repeat(lens[:1], 5, axis=0)
    with pytest.raises(BaselineTooShortError, match="all 5 views have the same lens position"):
        fit(views_of(still, directions(still)))


def test_points_at_infinity_have_no_place_and_no_gap() -> None:
    lens = lens_path(10)
    parallel = np.repeat(directions(lens[:1]), 10, axis=0)
    away = parallel + 0.05 * (lens - lens.mean(axis=0))[:, None] / 0.004
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    fitted = fit(views_of(lens, away))
    assert np.isnan(fitted.gap)
    assert np.isnan(fitted.points).all()
    assert fitted.inverse_depth_variation == np.inf
    assert np.isnan(fitted.shares).all()


def test_repeated_views_weigh_as_often_as_they_come() -> None:
    views = noisy(np.random.default_rng(31), 6)
    twice = views_of(np.tile(views.lens_positions, (2, 1)), np.tile(views.bearings, (2, 1, 1)))
    once = fit(views)
    assert fit(twice).gap == pytest.approx(once.gap, rel=1e-3)


BAD = {
    "lens_positions must be finite": {"lens": np.nan},
    "bearing 1 of view 2 must have length 1, not 2": {"length": 2.0},
    "bearing_covariances must be positive semi-definite": {"sign": -1.0},
    "at most 0.5 rad": {"deviation": 3.0},
    "must be above 0 rad": {"deviation": 0.0},
    r"common_share must lie in \[0, 1\], not 1.5": {"share": 1.5},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_views_are_refused_by_value_and_rule(message: str) -> None:
    bad = BAD[message]
    lens = lens_path(5)
    bearings = directions(lens)
    covariances = bad.get("sign", 1.0) * bearing_covariances(bearings, bad.get("deviation", DEVIATION))
    lens[3, 1] = bad.get("lens", lens[3, 1])
    bearings[2, 1] *= bad.get("length", 1.0)
    with pytest.raises(BadInputError, match=message):
        views_of(lens, bearings, share=bad.get("share", 0.5), bearing_covariances=covariances)


def test_shapes_and_asymmetry_and_rotations_are_refused() -> None:
    lens = lens_path(3)
    bearings = directions(lens)
    with pytest.raises(BadInputError, match=r"bearings must have shape \(3, 2, 3\), not \(2, 2, 3\)"):
        views_of(lens, bearings[:2])
    skew = isotropic_covariances(3, LENS_RMS)
    skew[0, 0, 1] = skew[0, 0, 0]
    with pytest.raises(BadInputError, match="lens_covariances must be symmetric"):
        views_of(lens, bearings, lens_covariances=skew)
    with pytest.raises(BadInputError, match="lens_rotations must be rotation matrices"):
        views_of(lens, bearings, lens_rotations=np.tile(2.0 * np.eye(3), (3, 1, 1)))


def test_result_is_complete_and_finite_for_very_many_views() -> None:
    fitted: MultiViewFit = fit(noisy(np.random.default_rng(41), 1000, share=0.5))
    assert fitted.view_count == 1000
    assert np.isfinite(fitted.covariance).all()
    assert np.linalg.eigvalsh(fitted.covariance).min() > 0.0


@pytest.mark.parametrize("count", [3, 40, 240])
def test_a_lens_that_only_seems_to_move_gives_no_depth(count: int) -> None:
    """Its positions differ by their errors alone: however precise the bearings, nothing may be accepted."""
    rng = np.random.default_rng(51)
    lens = np.zeros((count, 3))
    for _ in range(20):
        measured = rng.standard_normal((count, 3)) * LENS_RMS / np.sqrt(3.0)
        fitted = fit(views_of(measured, directions(lens), deviation=1e-5))
        assert not fitted.inverse_depth_variation <= 0.3
        assert confidence_interval(fitted).refused


def test_nonsense_is_refused_or_answered_but_never_accepted_without_numbers() -> None:
    rng = np.random.default_rng(52)
    accepted = 0
    for _ in range(1500):
        count = int(rng.choice([2, 3, 4, 5, 10, 40]))
        lens = rng.standard_normal((count, 3)) * 10.0 ** rng.uniform(-9.0, 0.0)
        bearings = 10.0 ** rng.uniform(-3.0, 3.0) * rng.standard_normal((2, 3)) - lens[:, None]
        kind = rng.integers(5)
        if kind == 0:
            bearings = rng.standard_normal((count, 2, 3))
        elif kind == 1:
            bearings = np.repeat(rng.standard_normal((1, 2, 3)), count, axis=0)
        elif kind == 2:
            bearings[::2] *= -1.0
        elif kind == 3:
            bearings[:, 1] = bearings[:, 0]
        bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
        fitted = fit(
            views_of(
                lens,
                bearings,
                deviation=10.0 ** rng.uniform(-6.0, -0.4),
                share=float(rng.choice([0.0, 0.5, 1.0])),
                lens_covariances=isotropic_covariances(count, 10.0 ** rng.uniform(-8.0, -1.0)),
                rotation_covariances=isotropic_covariances(count, 10.0 ** rng.uniform(-6.0, 0.0)),
            )
        )
        interval = confidence_interval(fitted)
        assert 0.0 <= interval.lower <= interval.upper
        if not interval.refused:
            accepted += 1
            assert np.isfinite(fitted.covariance).all()
            assert interval.lower <= fitted.gap * (1.0 + 1e-9)
            assert fitted.gap <= interval.upper * (1.0 + 1e-9)
    assert accepted > 50
