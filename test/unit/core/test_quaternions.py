"""Compiled rotations are those of scipy's Rotation, to the last digit but one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values import quaternions


def assert_close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-13, atol=1e-15)


@pytest.fixture(params=range(20))
def pair(request):
    """Two quaternions of any length, which may lie close to each other."""
    rng = np.random.default_rng(request.param)
    one = rng.standard_normal(4)
    return one, one + rng.standard_normal(4) * 10.0 ** rng.uniform(-9, 1)


def test_products_matrices_and_vectors(pair):
    one, other = (quaternions.unit_quaternion(q) for q in pair)
    first, second = (Rotation.from_quat(q) for q in pair)
    assert_close(one, first.as_quat())
    assert_close(quaternions.matrix(one), first.as_matrix())
    assert_close(quaternions.product(one, other), (first * second).as_quat())
    assert_close(
        quaternions.canonical(quaternions.product(one, other)),
        (first * second).as_quat(canonical=True),
    )
    assert_close(quaternions.rotation_vector(one), first.as_rotvec())


def test_the_turn_from_one_to_the_other(pair):
    first, second = (Rotation.from_quat(q) for q in pair)
    assert_close(quaternions.turn_from(*pair), (second * first.inv()).as_rotvec())


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_way(pair, share):
    first, second = (Rotation.from_quat(q) for q in pair)
    turn = Rotation.from_rotvec(share * (second * first.inv()).as_rotvec())
    assert_close(quaternions.between(pair[0], pair[1], share), (turn * first).as_quat(canonical=True))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-4, 1.1e-3, 1.0, 3.1])
def test_from_a_rotation_vector(angle):
    vector = angle * np.array([0.6, -0.8, 0.0])
    assert_close(quaternions.from_rotation_vector(vector), Rotation.from_rotvec(vector).as_quat())


def test_of_two_opposite_quaternions_the_canonical_one_has_no_negative_w():
    for quaternion in ([0.0, -1.0, 0.0, 0.0], [0.5, 0.5, 0.5, -0.5], [0.0, 0.0, 0.6, 0.8]):
        one = np.array(quaternion)
        np.testing.assert_array_equal(
            quaternions.canonical(one), Rotation.from_quat(one).as_quat(canonical=True)
        )
