"""The window of views: bounded, spread, and unmoved by a lens that stands still."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.multi_view.keyframe_window import ViewWindow
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import (
    Views,
    bearing_covariances,
    isotropic_covariances,
    joined,
)

Floats = npt.NDArray[np.float64]

POINTS = np.array([[-0.002, 0.0, 0.010], [0.002, 0.0, 0.011]])
LENS_RMS = 3.67e-5


def view_at(lens: Floats, rng: np.random.Generator, lens_rms: float = LENS_RMS) -> Views:
    """One noisy view of the points."""
    towards = POINTS - lens
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True) + 0.005 * rng.standard_normal((2, 3))
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    measured = lens + rng.standard_normal(3) * LENS_RMS / np.sqrt(3.0)
    return Views(
        measured[None],
        bearings[None],
        bearing_covariances(bearings[None], 0.005),
        isotropic_covariances(1, lens_rms),
        isotropic_covariances(1, 1e-4),
    )


def test_a_lens_that_stands_still_neither_drifts_nor_grows_the_window() -> None:
    rng = np.random.default_rng(1)
    window = ViewWindow()
    for travelled in np.linspace(0.0, 0.004, 200):
        window.add(view_at(np.array([travelled, 0.0, 0.0]), rng))
    before = fit(window.views(0.5))
    for _ in range(3000):
        window.add(view_at(np.array([0.004, 0.0, 0.0]), rng))
    after = fit(window.views(0.5))
    assert after.view_count <= before.view_count + 2
    assert abs(after.gap - before.gap) < 0.3 * before.gap_deviation


def test_a_tremor_of_ten_minutes_stays_bounded() -> None:
    rng = np.random.default_rng(2)
    window = ViewWindow()
    for k in range(4000):
        tremor = 1e-4 * np.array([np.sin(0.9 * k), np.cos(0.7 * k), np.sin(0.31 * k)])
        window.add(view_at(tremor, rng))
    assert len(window) < 12


def test_the_window_is_never_fuller_than_its_capacity_and_stays_spread() -> None:
    rng = np.random.default_rng(3)
    window = ViewWindow(40)
    largest = 0
    for k in range(4000):
        window.add(view_at(np.array([k * 1e-5, 0.0, 0.0]), rng))
        largest = max(largest, len(window))
    places = window.views(0.5).lens_positions[:, 0]
    assert largest <= 40
    assert len(window) >= 15
    assert places[0] == pytest.approx(0.0, abs=5 * LENS_RMS)
    assert places[-1] > 0.039
    assert np.diff(places).max() < 4e-3


def test_the_first_view_is_kept_and_they_are_in_order_of_time() -> None:
    rng = np.random.default_rng(4)
    window = ViewWindow(10)
    first = view_at(np.zeros(3), rng)
    assert window.add(first)
    for k in range(1, 500):
        window.add(view_at(np.array([0.0, k * 5e-5, 0.0]), rng))
    kept = window.views(0.5).lens_positions
    np.testing.assert_array_equal(kept[0], first.lens_positions[0])
    assert np.all(np.diff(kept[:, 1]) > 0.0)


def test_lens_positions_of_kept_views_are_not_chosen_for_their_errors() -> None:
    """A slow lens: the first view beyond the spacing is one whose error points ahead, and is not kept."""
    rng = np.random.default_rng(5)
    ahead = []
    for _ in range(60):
        window, truth = ViewWindow(), []
        for k in range(150):
            place = np.array([k * 4e-6, 0.0, 0.0])
            if window.add(view_at(place, rng)):
                truth.append(place[0])
        ahead.extend(window.views(0.5).lens_positions[1:, 0] - truth[1:])
    deviation = LENS_RMS / np.sqrt(3.0)
    assert len(ahead) > 60
    assert abs(np.mean(ahead)) < 4.0 * deviation / np.sqrt(len(ahead))


def test_views_without_position_error_are_thinned_too() -> None:
    rng = np.random.default_rng(6)
    window = ViewWindow(8)
    for k in range(100):
        window.add(view_at(np.array([k * 1e-4, 0.0, 0.0]), rng, lens_rms=0.0))
    assert 2 <= len(window) <= 8


def test_an_empty_window_and_two_views_at_once_are_refused() -> None:
    window = ViewWindow()
    with pytest.raises(BadInputError, match="the window is empty"):
        window.views(0.5)
    one = view_at(np.zeros(3), np.random.default_rng(7))
    with pytest.raises(BadInputError, match="one view is added at a time, not 2"):
        window.add(one.joined(one))
    with pytest.raises(BadInputError, match="at least 2 views, not 1"):
        ViewWindow(1)


def one_view() -> Views:
    return view_at(np.zeros(3), np.random.default_rng(2))


def test_what_one_part_does_not_know_is_unknown_of_all() -> None:
    known, unknown = one_view(), replace(one_view(), times=None)
    known = replace(known, times=np.array([3.0]), motion_times=np.array([0.02]))
    unknown = replace(unknown, motion_times=np.array([0.03]))
    both = joined([known, unknown], 0.25)
    assert both.times is None
    np.testing.assert_array_equal(both.motion_times, [0.02, 0.03])
    assert len(both) == 2
    assert both.common_share == 0.25


def test_errors_of_different_cameras_are_not_put_together() -> None:
    one, other = (replace(one_view(), camera_errors=np.zeros((1, 2, 3, k))) for k in (2, 4))
    assert joined([one, other], 0.5).camera_errors is None
    assert joined([one, one], 0.5).camera_errors.shape == (2, 2, 3, 2)
    with pytest.raises(BadInputError):
        joined([], 0.5)
