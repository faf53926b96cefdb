"""A drift along the parallax: what it does to the points, and that the interval then holds."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from knee_gap_uncertainty.multi_view.confidence_interval import confidence_interval
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit
from knee_gap_uncertainty.multi_view.scale_drift import single_view_drift, with_scale_drift
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances

VIEWS, MANY, DEVIATION = 30, 600, 0.0003
POINTS = np.array([[-0.002, 0.001, 0.012], [0.003, 0.0, 0.010]])


def drifting(
    shares: np.ndarray, rng: np.random.Generator | None = None, count: int = VIEWS
) -> tuple[MultiViewFit, Views]:
    """Fit to bearings that run ahead of their parallax since the first view by `shares` (2,) of it."""
    lens = np.zeros((count, 3))
    # The track does not begin where the frame does.
    lens[:, 1] = 0.001
    lens[:, 0], lens[:, 2] = np.linspace(0.0, 0.003, count), np.linspace(0.0, 0.004, count)
    # Run ahead by a share of the parallax, which is that of a lens that went farther.
    ahead = lens[0] + (lens[:, None] - lens[0]) * (1.0 + shares[:, None])
    rays = POINTS - ahead
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
    moved, views = drifting(shares)
    first = views.lens_positions[0]
    assert moved.points == pytest.approx(first + (POINTS - first) / (1.0 + shares[:, None]), abs=1e-8)
    assert moved.chi_square_ratio < 1e-6


def test_without_drift_the_fit_stays_what_it_is() -> None:
    fitted, views = drifting(np.zeros(2))
    assert with_scale_drift(fitted, views, views.lens_positions[0], 0.0, 0.0) is fitted


def test_shares_still_sum_to_one_and_the_common_one_grows() -> None:
    fitted, views = drifting(np.zeros(2))
    wider = with_scale_drift(fitted, views, views.lens_positions[0], 0.01, 0.0)
    assert wider.shares.sum() == pytest.approx(1.0)
    assert wider.shares[3] > fitted.shares[3]


def test_the_interval_holds_with_the_drift_and_not_without() -> None:
    rng, drift, runs = np.random.default_rng(4), 0.02, 300
    truth = float(np.linalg.norm(POINTS[1] - POINTS[0]))
    held = np.zeros(2)
    for _ in range(runs):
        fitted, views = drifting(drift * rng.standard_normal(2), rng)
        for k, assumed in enumerate((0.0, drift)):
            wider = with_scale_drift(fitted, views, views.lens_positions[0], assumed, 0.0)
            interval = confidence_interval(wider)
            held[k] += interval.lower <= truth <= interval.upper
    # Four standard deviations of a share of 0.95.
    assert held[1] / runs == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / runs))
    assert held[0] / runs < 0.8


def _drift_of_a_view(views: Views, index: int, n: int) -> float:
    """Drift [-] at which the bearing of a view turns by the standard deviation, by bisection."""
    lens = views.lens_positions[index]
    still = POINTS[n] - lens

    def turn(share: float) -> float:
        moved = views.lens_positions[0] + (POINTS[n] - views.lens_positions[0]) * (1.0 + share) - lens
        sine = np.linalg.norm(np.cross(moved, still)) / np.linalg.norm(moved) / np.linalg.norm(still)
        return float(np.arcsin(sine))

    return float(brentq(lambda share: turn(share) - DEVIATION, 0.0, 0.5))


def test_the_drift_that_is_open_is_the_error_against_the_parallax_of_one_of_the_best_views() -> None:
    fitted, views = drifting(np.zeros(2))
    drifts = single_view_drift(fitted, views, views.lens_positions[0])
    for n in range(2):
        each = np.sort([_drift_of_a_view(views, index, n) for index in range(5, VIEWS)])
        # The first decile of the 29 views that measure any lies between the third and the fourth.
        assert drifts[n] == pytest.approx(0.2 * each[2] + 0.8 * each[3], rel=0.05)


def _with_covariances(views: Views, change: Callable[[np.ndarray], None]) -> Views:
    covariances = views.bearing_covariances.copy()
    change(covariances)
    return replace(views, bearing_covariances=covariances)


def test_a_view_that_claims_to_know_all_does_not_speak_for_the_others() -> None:
    fitted, views = drifting(np.zeros(2))
    before = single_view_drift(fitted, views, views.lens_positions[0])

    def boast(covariances: np.ndarray) -> None:
        covariances[20] *= 1e-6

    after = single_view_drift(fitted, _with_covariances(views, boast), views.lens_positions[0])
    assert after == pytest.approx(before, rel=0.1)


def test_a_covariance_without_an_inverse_gives_a_number() -> None:
    fitted, views = drifting(np.zeros(2))

    def flatten(covariances: np.ndarray) -> None:
        # Null along the travel as well, or a little less by rounding.
        covariances[10:13, :, :, 0] = covariances[10:13, :, 0, :] = 0.0
        covariances[10:13, :, 0, 0] = -1e-20

    flat = _with_covariances(views, flatten)
    wider = with_scale_drift(fitted, flat, views.lens_positions[0], 0.002, 1.0)
    assert np.isfinite(wider.covariance).all()
    assert np.isfinite(wider.shares).all()
    assert wider.gap_deviation > fitted.gap_deviation


def test_an_error_beside_the_turn_that_goes_with_one_along_it_is_made_use_of() -> None:
    """A line in the picture 30 degrees from the parallax: its error of depth is not along its long axis."""
    fitted, views = drifting(np.zeros(2))
    turned = np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0.0])

    def stretch(covariances: np.ndarray) -> None:
        for view, n in np.ndindex(VIEWS, 2):
            across = np.eye(3) - np.outer(views.bearings[view, n], views.bearings[view, n])
            covariances[view, n] += 99.0 * DEVIATION**2 * across @ np.outer(turned, turned) @ across

    line = single_view_drift(fitted, _with_covariances(views, stretch), views.lens_positions[0])
    plain = single_view_drift(fitted, views, views.lens_positions[0])
    assert (line > 1.2 * plain).all()
    assert (line < 4.0 * plain).all()


def test_where_residuals_show_larger_errors_more_is_left_open() -> None:
    fitted, views = drifting(np.zeros(2))
    scaled = replace(fitted, scale=9.0)
    one, nine = (
        with_scale_drift(each, views, views.lens_positions[0], 0.0, 1.0) for each in (fitted, scaled)
    )
    added = one.covariance - fitted.covariance
    assert nine.covariance - fitted.covariance == pytest.approx(9.0 * added, rel=1e-9)


def test_an_error_that_lasts_is_held_however_many_views_repeat_it_and_not_by_far_too_much() -> None:
    """Each view by itself errs along its parallax as much as it states, and all of them the same way."""
    rng, runs = np.random.default_rng(5), 400
    truth = float(np.linalg.norm(POINTS[1] - POINTS[0]))
    _, views = drifting(np.zeros(2))
    drift = np.array([_drift_of_a_view(views, VIEWS - 1, n) for n in range(2)])
    held = np.zeros(2)
    for _ in range(runs):
        fitted, views = drifting(drift * rng.standard_normal(2), count=MANY)
        for k, share in enumerate((0.0, 1.0)):
            wider = with_scale_drift(fitted, views, views.lens_positions[0], 0.0, share)
            interval = confidence_interval(wider)
            held[k] += interval.lower <= truth <= interval.upper
    assert held[0] / runs < 0.8
    assert 0.95 < held[1] / runs < 0.995
