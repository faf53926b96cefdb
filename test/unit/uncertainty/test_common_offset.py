"""A common offset too large for first order: how far the interval's ends move, and that they then hold."""

from dataclasses import replace

import numpy as np
import pytest

from knee_gap_uncertainty.multi_view.common_offset import STRAIGHT
from knee_gap_uncertainty.multi_view.confidence_interval import confidence_interval, interval_ends
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances
from knee_gap_uncertainty.studies.coverage.cells import ERROR_SETS, Cell, Scene
from knee_gap_uncertainty.studies.coverage.intervals import intervals
from knee_gap_uncertainty.studies.coverage.tracks import simulate, true_bearings, true_track

VIEWS = 60
# Points up to 80 degrees off the axis, and up to 62 degrees.
FAR, NEAR = Scene(0.004, 0.012, 0.010, 90), Scene(0.004, 0.012, 0.003, 90)


def fit_without_noise(scene: Scene, deviation: float, share: float) -> MultiViewFit:
    lens, points = true_track(scene, VIEWS)
    bearings = true_bearings(lens, points)
    small = np.tile(np.eye(3) * 1e-12, (VIEWS, 1, 1))
    covariances = bearing_covariances(bearings, deviation)
    return fit(Views(lens, bearings, covariances, small, small, common_share=share))


@pytest.mark.parametrize(("deviation", "share"), [(0.05, 0.0), (0.001, 1.0), (0.012, 0.5)])
def test_a_small_or_independent_error_bends_nothing(deviation: float, share: float) -> None:
    fitted = fit_without_noise(NEAR, deviation, share)
    assert fitted.bend == STRAIGHT


def test_the_ends_move_with_the_square_of_the_offset() -> None:
    small, large = (fit_without_noise(FAR, deviation, 1.0).bend for deviation in (0.012, 0.024))
    assert small.skew != 0.0
    assert large.mean / small.mean == pytest.approx(4.0, rel=0.2)
    assert large.skew / small.skew == pytest.approx(4.0, rel=0.2)
    assert large.widening > small.widening > 1.0


def test_an_offset_that_reaches_infinity_is_no_bound() -> None:
    interval = confidence_interval(fit_without_noise(FAR, 0.4, 1.0))
    assert interval.refused
    assert interval.upper == np.inf


@pytest.mark.parametrize("scene", [FAR, NEAR])
def test_the_interval_holds_where_first_order_alone_does_not(scene: Scene) -> None:
    cell = Cell(scene, ERROR_SETS[1], VIEWS, "common", "gaussian", "right")
    tracks = simulate(cell, 600, np.random.default_rng(20))
    found = intervals(tracks, cell)
    held = (found.lower <= tracks.gap) & (tracks.gap <= found.upper)
    assert 0.93 <= held[found.accepted].mean() <= 0.975

    straight = []
    for run in np.flatnonzero(found.accepted):
        turns = np.tile(np.eye(3), (VIEWS, 1, 1))
        views = Views(
            tracks.lens[run],
            tracks.bearings[run],
            bearing_covariances(tracks.bearings[run], tracks.deviation),
            turns * tracks.lens_variance,
            turns * tracks.rotation_variance,
            common_share=1.0,
        )
        fitted = replace(fit(views), bend=STRAIGHT)
        ends = interval_ends(fitted.frames, fitted.unknowns, fitted.unknowns_covariance, 1.96, fitted.bend)
        straight.append(ends[0] <= tracks.gap <= ends[1])
    assert np.mean(straight) < held[found.accepted].mean() - 0.02
