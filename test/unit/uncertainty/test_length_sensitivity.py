"""The laws of triangulation and of the length of a ray: equations (1)-(12)."""

import math

import numpy as np
import pytest
from vectors import unit

from knee_gap_uncertainty.two_view.angle_sets import SIGNS, angle_changes
from knee_gap_uncertainty.two_view.length_sensitivity import (
    length_bound_linear,
    length_change,
    length_change_linear,
    length_error,
)
from knee_gap_uncertainty.two_view.translation_volume import DIRECTIONS, displacements
from knee_gap_uncertainty.two_view.triangulation import triangulate
from knee_gap_uncertainty.two_view.two_views import two_views


def triangles(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        own, other = rng.uniform(0.3, 1.4, 2)
        yield rng.uniform(1e-3, 8e-3), own, other


def test_exact_bearings_give_the_points_from_either_lens():
    rng = np.random.default_rng(1)
    for _ in range(100):
        lens_0, lens_1 = rng.uniform(-1e-2, 1e-2, (2, 3))
        points = rng.uniform(-1e-2, 1e-2, (2, 3))
        found = triangulate(two_views(lens_0, lens_1, unit(points - lens_0), unit(points - lens_1)))
        np.testing.assert_allclose(found.points_first, points, atol=1e-11)
        np.testing.assert_allclose(found.points_second, points, atol=1e-11)
        np.testing.assert_allclose(found.alpha + found.beta + found.gamma, math.pi, rtol=1e-14)
        assert found.gap_first == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=1e-7)
        assert found.gap_second == pytest.approx(found.gap_first, rel=1e-7)


def test_linear_change_is_the_derivative_of_the_exact_one():
    step = 1e-6
    for travel, own, other in triangles(50):
        for name in ("travel_change", "own_change", "other_change"):
            exact = length_change(travel, own, other, **{name: step}) - length_change(
                travel, own, other, **{name: -step}
            )
            linear = length_change_linear(travel, own, other, **{name: 1.0})
            assert linear == pytest.approx(exact / (2 * step), rel=1e-6, abs=1e-9)


def test_linear_change_errs_in_second_order():
    for travel, own, other in triangles(20, seed=2):
        changes = {"own_change": 2e-3, "other_change": -1e-3, "travel_change": 1e-6}
        halved = {name: value / 2 for name, value in changes.items()}
        misses = [
            abs(length_change(travel, own, other, **c) - length_change_linear(travel, own, other, **c))
            for c in (changes, halved)
        ]
        assert misses[0] == pytest.approx(4 * misses[1], rel=0.05)


def test_the_published_form_exceeds_the_derivative_for_growing_angles():
    """It drops cosines, which only shrink the terms of a growing angle."""
    for travel, own, other in triangles(50, seed=3):
        changes = {"own_change": 0.01, "other_change": 0.02, "travel_change": 1e-5}
        assert length_bound_linear(travel, own, other, **changes) >= length_change_linear(
            travel, own, other, **changes
        )


def test_a_longer_travel_lengthens_in_proportion():
    for travel, own, other in triangles(10, seed=4):
        length = travel * math.sin(other) / math.sin(own + other)
        assert length_change(travel, own, other, travel_change=travel) == pytest.approx(length, rel=1e-12)


def test_exact_change_leaves_no_error_and_signs_agree():
    for travel, own, other in triangles(20, seed=5):
        perturbed = np.array([own + 0.02, other - 0.01])
        own_change, other_change = angle_changes(np.array([own, other]), perturbed)
        true_length = travel * math.sin(perturbed[1]) / math.sin(perturbed.sum())
        length = travel * math.sin(other) / math.sin(own + other)
        change = length_change(travel, own, other, own_change=own_change, other_change=other_change)
        assert length_error(true_length, length, change) == pytest.approx(0, abs=1e-15)


def test_directions_are_twelve_different_unit_vectors_and_their_opposites_balance():
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1, rtol=1e-15)
    apart = np.linalg.norm(DIRECTIONS[:, None] - DIRECTIONS, axis=2) + 10 * np.eye(12)
    assert apart.min() > 0.9
    np.testing.assert_allclose(DIRECTIONS.sum(axis=0), 0, atol=1e-15)


@pytest.mark.parametrize("radii", [1, 4])
def test_displacements_fill_the_ball_in_equal_steps(radii):
    lengths = np.linalg.norm(displacements(3e-5, radii), axis=1)
    np.testing.assert_allclose(
        np.unique(lengths.round(12)), 3e-5 * np.arange(1, radii + 1) / radii, rtol=1e-6
    )
    assert len(lengths) == 12 * radii
    assert displacements(0.0, radii).tolist() == [[0.0, 0.0, 0.0]]


def test_all_signs_are_same_and_opposite():
    parts = np.vstack([SIGNS["same"], SIGNS["opposite"]]).tolist()
    assert sorted(parts) == sorted(SIGNS["all"].tolist())
    assert SIGNS["none"].tolist() == [[0.0, 0.0]]
