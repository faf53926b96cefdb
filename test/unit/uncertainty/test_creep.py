"""A tracked body that creeps on its scope: what the views show of it, and what the bounds admit otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from test_joint_motion import EXACT, POINTS, observe

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_uncertainty.estimation.estimator import GapEstimator
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.joint_motion.joint_motion import LARGEST_CREEP
from knee_gap_uncertainty.joint_motion.motion_statistics import (
    LARGEST_PRESENT,
    motion_statistics,
    observations,
)
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views, bearing_covariances, isotropic_covariances
from knee_gap_uncertainty.scope_calibration.scope_calibration import shared_error

TIMES = np.arange(120) / 60.0
UNIFORM = 2.7e-3 * TIMES
FROM_REST = 2.7e-3 * (1.0 - np.cos(np.pi * TIMES / 2.0))
RATES = (EXACT.tracker_drift, EXACT.unproven_drift)


def travelling(way: Array, rate: float, seed: int = 1) -> Views:
    """Views of still points by a lens on its `way` (N,) [m], tracked on a body that creeps along it [m/s]."""
    rng = np.random.default_rng(seed)
    lens = way[:, None] * [1.0, 0.0, 0.0]
    bearings = POINTS - lens[:, None] + 1e-5 * rng.standard_normal((len(way), 2, 3))
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    tracked = lens + rate * TIMES[:, None] * [1.0, 0.0, 0.0] + 2e-5 * rng.standard_normal(lens.shape)
    covariances = isotropic_covariances(len(way), 3.7e-5), isotropic_covariances(len(way), 7e-5)
    return Views(tracked, bearings, bearing_covariances(bearings, 1e-3), *covariances, times=TIMES)


@pytest.mark.parametrize("rate", [1e-3, -1e-3, 0.0])
def test_creep_shows_where_the_speed_of_the_scope_varies(rate: float) -> None:
    views = travelling(FROM_REST, rate)
    found = motion_statistics(observations(views), fit(views), RATES)
    assert (found.creep > LARGEST_CREEP or found.present > LARGEST_PRESENT) == (rate != 0.0)
    if rate == 0.0:
        assert found.largest_rate < 0.5 * EXACT.tracker_bound * EXACT.unproven_drift
    else:
        assert found.largest_rate > abs(rate)


@pytest.mark.parametrize("rate", [1e-3, -1e-3, 0.0])
def test_uniform_motion_shows_no_creep_and_leaves_any_possible(rate: float) -> None:
    views = travelling(UNIFORM, rate)
    found = motion_statistics(observations(views), fit(views), RATES)
    assert found.creep < LARGEST_CREEP
    assert found.largest_rate > 2.0 * EXACT.unproven_drift


def measured(way: Array, rate: float, parameters: EstimatorParameters) -> list[GapEstimate]:
    """Estimates of the estimator itself: points that creep against the tracked lens."""
    points = POINTS + rate * TIMES[:, None, None] * [1.0, 0.0, 0.0]
    lens = way[:, None] * [1.0, 0.0, 0.0]
    nothing = np.zeros((len(way), 2, 3))
    return observe(GapEstimator(parameters), lens, nothing, np.random.default_rng(2), points)


def test_bounds_hold_a_creep_that_no_view_can_show_until_it_is_disproved() -> None:
    true_gap = measured(FROM_REST, 0.0, EXACT)[-1].gap
    creeping = [one for one in measured(UNIFORM, 1e-3, EXACT) if one.status is GapStatus.VALID]
    assert creeping
    assert all(one.gap_min < true_gap < one.gap_max for one in creeping)
    trusting = measured(UNIFORM, 1e-3, replace(EXACT, unproven_drift=0.0))
    assert not all(one.gap_min < true_gap < one.gap_max for one in trusting if one.status is GapStatus.VALID)
    # A scope that begins at rest disproves most of it.
    parameters = (EXACT, replace(EXACT, unproven_drift=0.0))
    proven, trusted = (measured(FROM_REST, 0.0, each)[-1] for each in parameters)
    uniform = measured(UNIFORM, 0.0, EXACT)[-1]
    assert proven.status is GapStatus.VALID
    widths = [one.gap_max - one.gap_min for one in (trusted, proven, uniform)]
    assert widths[1] - widths[0] < 0.25 * (widths[2] - widths[0]), widths


def test_a_scale_of_the_tracker_enters_the_bounds_along_the_baseline() -> None:
    none, some = (
        measured(FROM_REST, 0.0, replace(EXACT, tracker_scale=scale, unproven_drift=0.0))[-1]
        for scale in (0.0, 0.05)
    )
    error = shared_error([], replace(EXACT, tracker_scale=0.05, tracker_drift=0.0))
    assert error.scale == 0.05
    assert some.gap_max - some.gap > none.gap_max - none.gap + 0.1 * some.gap
    assert some.gap - some.gap_min > none.gap - none.gap_min + 0.05 * some.gap
    # The interval takes one standard error of the scale, that all views share.
    half = (some.confidence_max - some.confidence_min) / 2.0
    assert half > 1.96 * 0.045 * some.gap
