"""A drift along the parallax: what it does to the points, and that the interval then holds."""

import numpy as np
import pytest

from knee_gap_uncertainty.confidence_interval import confidence_interval
from knee_gap_uncertainty.depth_drift import single_view_drift, with_depth_drift
from knee_gap_uncertainty.multi_view import MultiViewFit, fit
from knee_gap_uncertainty.views import Views, bearing_covariances

VIEWS, MANY, DEVIATION = 30, 600, 0.0003
POINTS = np.array([[-0.002, 0.001, 0.012], [0.003, 0.0, 0.010]])


def drifting(
    shares: np.ndarray, rng: np.random.Generator | None = None, count: int = VIEWS
) -> tuple[MultiViewFit, Views]:
    """Fit to bearings that run ahead of their parallax since the first view by `shares` (2,) of it."""
    lens = np.zeros((count, 3))
    lens[:, 0], lens[:, 2] = np.linspace(0.0, 0.003, count), np.linspace(0.0, 0.004, count)
    rays = POINTS - lens[:, None] * (1.0 + shares[:, None])
    if rng is not None:
        noise = DEVIATION * rng.standard_normal(rays.shape)
        rays = rays + np.linalg.norm(rays, axis=-1, keepdims=True) * noise
    bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    small = np.tile(np.eye(3) * 1e-14, (count, 1, 1))
    covariances = bearing_covariances(bearings, DEVIATION)
    views = Views(lens, bearings, covariances, small, small, common_share=0.0)
    return fit(views), views


def test_drift_moves_points_along_their_first_rays() -> None:
    shares = np.array([0.01, -0.02])
    moved, _ = drifting(shares)
    assert moved.points == pytest.approx(POINTS / (1.0 + shares[:, None]), abs=1e-8)
    assert moved.chi_square_ratio < 1e-6


def test_without_drift_the_fit_stays_what_it_is() -> None:
    fitted, views = drifting(np.zeros(2))
    assert with_depth_drift(fitted, views, views.lens_positions[0], 0.0, 0.0) is fitted


def test_shares_still_sum_to_one_and_the_common_one_grows() -> None:
    fitted, views = drifting(np.zeros(2))
    wider = with_depth_drift(fitted, views, views.lens_positions[0], 0.01, 0.0)
    assert wider.shares.sum() == pytest.approx(1.0)
    assert wider.shares[3] > fitted.shares[3]


def test_the_interval_holds_with_the_drift_and_not_without() -> None:
    rng, drift, runs = np.random.default_rng(4), 0.02, 300
    truth = float(np.linalg.norm(POINTS[1] - POINTS[0]))
    held = np.zeros(2)
    for _ in range(runs):
        fitted, views = drifting(drift * rng.standard_normal(2), rng)
        for k, assumed in enumerate((0.0, drift)):
            wider = with_depth_drift(fitted, views, views.lens_positions[0], assumed, 0.0)
            interval = confidence_interval(wider)
            held[k] += interval.lower <= truth <= interval.upper
    # Four standard deviations of a share of 0.95.
    assert held[1] / runs == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / runs))
    assert held[0] / runs < 0.8


def test_the_drift_that_a_view_leaves_open_is_its_error_against_its_parallax() -> None:
    """Of two views the second: the drift moves its bearing by what its own standard deviation allows."""
    fitted, views = drifting(np.zeros(2))
    drifts = single_view_drift(fitted, views, views.lens_positions[0])
    for n in range(2):
        moved = POINTS[n] * (1.0 + drifts[n]) - views.lens_positions[-1]
        still = POINTS[n] - views.lens_positions[-1]
        sine = np.linalg.norm(np.cross(moved, still)) / np.linalg.norm(moved) / np.linalg.norm(still)
        assert np.arcsin(sine) == pytest.approx(DEVIATION, rel=0.05)


def test_an_error_that_lasts_is_held_however_many_views_repeat_it() -> None:
    """The same registration error in every view, against its parallax as in the last."""
    rng, runs = np.random.default_rng(5), 300
    truth = float(np.linalg.norm(POINTS[1] - POINTS[0]))
    quiet, views = drifting(np.zeros(2), count=MANY)
    drift = single_view_drift(quiet, views, views.lens_positions[0])
    held = np.zeros(2)
    for _ in range(runs):
        fitted, views = drifting(drift * rng.standard_normal(2), count=MANY)
        for k, share in enumerate((0.0, 1.0)):
            wider = with_depth_drift(fitted, views, views.lens_positions[0], 0.0, share)
            interval = confidence_interval(wider)
            held[k] += interval.lower <= truth <= interval.upper
    assert held[0] / runs < 0.8
    assert held[1] / runs > 0.95
