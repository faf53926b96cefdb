"""Volumes of admitted errors: their distance against an optimiser, and the gap under such errors."""

import numpy as np
import pytest
from scipy.optimize import minimize
from vectors import unit

from knee_gap_uncertainty.numerics.vectors import vector
from knee_gap_uncertainty.two_view.cone_volume import ConeVolume, farthest_point, volume_distance
from knee_gap_uncertainty.two_view.gap_range import gap_range


def drawn(volume, count, rng):
    """Points all over a volume, many of them on its rim."""
    axis = np.array(volume.axis)
    side = unit(np.cross(axis, rng.normal(size=(count, 3))))
    off = volume.half_angle * np.minimum(1.0, rng.uniform(0.0, 1.5, (count, 1)))
    length = np.clip(rng.uniform(-0.3, 1.3, (count, 1)), 0.0, 1.0)
    length = volume.shortest + length * (volume.longest - volume.shortest)
    blur = (
        volume.blur * unit(rng.normal(size=(count, 3))) * np.minimum(1.0, rng.uniform(0.0, 1.5, (count, 1)))
    )
    return length * (np.cos(off) * axis + np.sin(off) * side) + blur


def random_volume(rng, axis):
    shortest = rng.uniform(5e-3, 15e-3)
    return ConeVolume(
        vector(unit(axis)),
        shortest,
        shortest * rng.uniform(1.0, 1.6),
        rng.uniform(0.01, 0.12),
        rng.uniform(0.0, 2e-4),
    )


def test_no_point_of_a_volume_lies_farther_than_the_farthest():
    rng = np.random.default_rng(1)
    for _ in range(50):
        volume = random_volume(rng, rng.normal(size=3))
        points = drawn(volume, 2000, rng)
        for direction in rng.normal(size=(5, 3)):
            reach = np.array(farthest_point(volume, vector(direction))) @ direction
            assert (points @ direction).max() <= reach + 1e-15
            assert (points @ direction).max() >= reach - 0.2 * volume.longest * np.linalg.norm(direction)


def test_distance_is_that_of_an_optimiser_over_separating_planes():
    """The distance of two convex bodies is the widest gap between parallel planes that part them."""
    rng = np.random.default_rng(2)
    apart = 0
    for _ in range(40):
        axis = unit(rng.normal(size=3))
        one = random_volume(rng, axis)
        other = random_volume(rng, axis + rng.uniform(0.1, 0.6) * unit(np.cross(axis, rng.normal(size=3))))

        def between(direction, one=one, other=other):
            n = unit(direction)
            return (
                np.array(farthest_point(one, vector(-n))) @ n - np.array(farthest_point(other, vector(n))) @ n
            )

        starts = np.vstack([rng.normal(size=(12, 3)), np.subtract(one.axis, other.axis)])
        best = max(-minimize(lambda n: -between(n), n, method="Nelder-Mead").fun for n in starts)
        found = volume_distance(one, other)
        assert found <= max(best, 0.0) + 1e-6
        assert found >= 0.98 * best - 1e-6
        apart += best > 0.0
    assert 10 <= apart <= 38


def test_volumes_that_meet_have_no_distance():
    one = ConeVolume((0.0, 0.0, 1.0), 0.01, 0.02, 0.05, 1e-4)
    assert volume_distance(one, one) == 0.0
    beside = one._replace(axis=vector(unit(np.array([0.09, 0.0, 1.0]))))
    assert volume_distance(one, beside) == 0.0
    assert volume_distance(one, one._replace(axis=vector(unit(np.array([0.2, 0.0, 1.0]))))) > 0.0


@pytest.mark.parametrize("apex", ["first", "second", "best"])
def test_gap_narrower_than_the_rings_is_never_below_its_least(apex):
    """A gap of 1 mm, 20 mm ahead, each bearing off by up to 5.6 degrees, the same in both views.

    The rings about the points are 2 mm wide, and a quarter of each has no sample.
    """
    rng = np.random.default_rng(3)
    theta, shift = np.radians(5.586), 0.07e-3
    travel = 10e-3 * np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])
    points = np.array([[-0.47e-3, 0.0, 19.83e-3], [0.47e-3, 0.0, 20.17e-3]])
    gap = np.linalg.norm(points[1] - points[0])
    reported, wide = 0, 0
    for _ in range(400):
        angle, radius = 2 * np.pi * rng.random((2, 1)), theta * np.sqrt(rng.uniform(0.7, 1.0, (2, 1)))
        offset = radius * np.hstack([np.cos(angle), np.sin(angle), np.zeros((2, 1))])
        lenses = np.array([-travel / 2, travel / 2]) + shift * unit(rng.normal(size=(2, 3)))
        seen = [unit(points - lens) for lens in (-travel / 2, travel / 2)]
        seen = [unit(np.cos(radius) * b + np.sinc(radius / np.pi) * offset) for b in seen]
        found = gap_range(
            *lenses,
            *seen,
            angular_error=1.05 * theta,
            translation_error=shift,
            interval="worst_case",
            apex=apex,
        )
        reported += found.gap_min > 0.0
        wide += found.gap > 3e-3
        assert found.gap_min <= gap <= found.gap_max
    assert wide > 40
