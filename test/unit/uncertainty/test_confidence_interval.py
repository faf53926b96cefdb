"""The confidence interval: extremes against a general optimiser, laws, refusal, and how often it holds."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import minimize

from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.multi_view.confidence_interval import confidence_interval
from knee_gap_uncertainty.multi_view.curvature_correction import accepted_above, stray_probability
from knee_gap_uncertainty.multi_view.ellipsoid_distance import largest_distance, smallest_distance
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit, points_of
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances
from knee_gap_uncertainty.studies.coverage.cells import ERROR_SETS, SHARES, Cell, Scene
from knee_gap_uncertainty.studies.coverage.intervals import intervals
from knee_gap_uncertainty.studies.coverage.tracks import simulate

Floats = npt.NDArray[np.float64]

SET_1, SET_2, FINE = ERROR_SETS


def fitted_to(travel: float, deviation: float = 0.01, seed: int = 1, count: int = 12) -> MultiViewFit:
    rng = np.random.default_rng(seed)
    lens = np.linspace(-0.5, 0.5, count)[:, None] * travel * np.array([0.8, 0.6, 0.0])
    towards = np.array([[-0.002, 0.0, 0.010], [0.002, 0.0, 0.011]]) - lens[:, None]
    bearings = towards + 0.01 * deviation * rng.standard_normal(towards.shape)
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    return fit(
        Views(
            lens,
            bearings,
            bearing_covariances(bearings, deviation),
            isotropic_covariances(count, 3.67e-5),
            isotropic_covariances(count, 1e-4),
        )
    )


@pytest.mark.parametrize("radius", [1.0, 1.96, 4.0])
@pytest.mark.parametrize("travel", [0.003, 0.006])
def test_extremes_are_those_of_a_general_optimiser(travel: float, radius: float) -> None:
    fitted = fitted_to(travel)
    factor = radius * np.linalg.cholesky(fitted.unknowns_covariance)

    def distance_mm(unit: Floats) -> float:
        places = points_of(fitted.centre, fitted.frames, fitted.unknowns + (factor @ unit).reshape(2, 3))
        return 1e3 * float(np.linalg.norm(places[1] - places[0]))

    ball = {"type": "ineq", "fun": lambda unit: 1.0 - unit @ unit}
    rng = np.random.default_rng(2)
    starts = 0.5 * rng.standard_normal((12, 6)) / np.sqrt(6.0)
    least = min(minimize(distance_mm, start, constraints=ball).fun for start in starts)
    most = max(-minimize(lambda unit: -distance_mm(unit), start, constraints=ball).fun for start in starts)
    work = (np.zeros(6), np.zeros(3), np.zeros((3, 6)))
    assert 1e3 * smallest_distance(fitted.frames, fitted.unknowns, factor, *work) == pytest.approx(
        least, rel=1e-4
    )
    assert 1e3 * largest_distance(fitted.frames, fitted.unknowns, factor, *work) == pytest.approx(
        most, rel=1e-4
    )


def test_interval_holds_the_estimate_and_grows_with_the_level() -> None:
    fitted = fitted_to(0.005)
    wide, narrow = confidence_interval(fitted, 0.99), confidence_interval(fitted, 0.5)
    assert wide.lower < narrow.lower < fitted.gap < narrow.upper < wide.upper
    assert not wide.refused


def test_small_errors_give_the_textbook_interval() -> None:
    fitted = fitted_to(0.008, deviation=0.0005)
    interval = confidence_interval(fitted)
    half = 1.959964 * fitted.gap_deviation
    assert interval.lower == pytest.approx(fitted.gap - half, abs=0.02 * half)
    assert interval.upper == pytest.approx(fitted.gap + half, abs=0.02 * half)


def test_interval_reaches_farther_up_than_down() -> None:
    fitted = fitted_to(0.003)
    interval = confidence_interval(fitted)
    assert interval.upper - fitted.gap > 1.1 * (fitted.gap - interval.lower)


def test_too_little_parallax_is_refused_and_its_lower_bound_told() -> None:
    interval = confidence_interval(fitted_to(0.0003))
    assert interval.refused
    assert "relative error of inverse depth" in interval.reason
    assert interval.upper == np.inf
    assert 0.0 < interval.lower < 0.0043


def test_points_beyond_infinity_are_refused() -> None:
    fitted = fitted_to(0.005)
    beyond = replace(fitted, unknowns=fitted.unknowns * np.array([1.0, 1.0, -1.0]))
    interval = confidence_interval(beyond)
    assert interval.refused
    assert interval.lower == 0.0


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, np.nan])
def test_a_level_outside_0_1_is_refused(level: float) -> None:
    with pytest.raises(BadInputError, match="confidence level must lie inside"):
        confidence_interval(fitted_to(0.005), level)


def test_stray_probability_of_a_sphere_is_that_of_chi() -> None:
    """Around a sphere of radius 3 in three dimensions, against simulated estimates."""
    estimates = np.random.default_rng(0).standard_normal((400_000, 3)) + np.array([3.0, 0.0, 0.0])
    radial = np.linalg.norm(estimates, axis=1) - 3.0
    simulated = np.mean(np.abs(radial) > 1.96)
    everyone = accepted_above(np.full(2, 9.0), np.zeros(2))
    assert stray_probability(1.96, 3.0, 3.0, 6.0, everyone) == pytest.approx(simulated, abs=0.003)
    assert stray_probability(1.96, 1e3, 1e3, 1e6, everyone) == pytest.approx(0.05, abs=1e-3)


def test_accepted_above_is_the_chance_of_both() -> None:
    rng = np.random.default_rng(1)
    distance, other = rng.standard_normal((2, 400_000))
    depth = -0.8 * distance + 0.6 * other
    above = accepted_above(np.array([0.5, 9.0]), np.array([-0.8, 0.0]))
    accepted = depth > -0.5
    assert above[0] == pytest.approx(accepted.mean(), abs=0.003)
    assert above[64 + 10] == pytest.approx(np.mean(accepted & (distance > 1.0)), abs=0.003)


RUNS = 2000
CELLS = [
    Cell(Scene(0.010, 0.004, 0.005, 45), SET_1, 10, "half", "gaussian", "right"),
    Cell(Scene(0.010, 0.004, 0.005, 45), SET_1, 2, "independent", "bounded", "right"),
    Cell(Scene(0.008, 0.004, 0.003, 90), FINE, 60, "common", "gaussian", "right"),
    # The gap is as small as its error.
    Cell(Scene(0.020, 0.001, 0.010, 90), SET_2, 2, "half", "gaussian", "right"),
    # Some runs are refused, those that seem too far.
    Cell(Scene(0.008, 0.012, 0.003, 45), SET_1, 2, "independent", "gaussian", "right"),
    # Wide angles.
    Cell(Scene(0.004, 0.012, 0.010, 0), SET_1, 10, "common", "bounded", "right"),
]


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: f"{cell.scene.gap * 1e3:g}mm-{cell.share}")
def test_interval_holds_the_truth_as_often_as_it_says(cell: Cell) -> None:
    tracks = simulate(cell, RUNS, np.random.default_rng(77))
    found = intervals(tracks, cell)
    accepted = found.accepted
    assert accepted.mean() > 0.85
    inside = (found.lower <= tracks.gap) & (tracks.gap <= found.upper)
    # 95 % within 1 %, and three deviations of a sample of this size.
    assert inside[accepted].mean() == pytest.approx(0.95, abs=0.01 + 3.0 * np.sqrt(0.05 * 0.95 / RUNS))


def test_a_wrong_common_share_is_what_the_interval_depends_on() -> None:
    """Bearings whose error is wholly common, taken for independent: the interval must then fail."""
    cell = Cell(Scene(0.010, 0.004, 0.005, 45), SET_1, 60, "common", "gaussian", "right")
    tracks = simulate(cell, 300, np.random.default_rng(5))
    assert SHARES[cell.share] == 1.0
    taken_for_independent = replace(cell, share="independent")
    found = intervals(tracks, taken_for_independent)
    inside = (found.lower <= tracks.gap) & (tracks.gap <= found.upper)
    assert inside.mean() < 0.8
