"""Whether hulls meet: against linear programming, and on shapes whose answer is known."""

import numpy as np
import pytest
from scipy.optimize import linprog, minimize
from scipy.spatial.transform import Rotation

from knee_gap_uncertainty.two_view.convex_distance import hull_distance, hulls_meet
from knee_gap_uncertainty.two_view.slices import slice_spokes

NONE = np.empty((3, 1, 0))
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)


def meet(one, other, *, one_far=NONE, other_far=NONE, guess=(1.0, 0.0, 0.0)):
    sliced = [
        slice_spokes(np.ascontiguousarray(cloud.T)[:, None, :], np.array([0, len(cloud)]))
        for cloud in (one, other)
    ]
    return hulls_meet(sliced[0], one_far, sliced[1], other_far, guess)


def meet_by_linear_programme(one, other):
    """A convex combination of one that equals one of the other."""
    equations = np.vstack(
        [
            np.hstack([one.T, -other.T]),
            np.repeat([1.0, 0.0], [len(one), len(other)]),
            np.repeat([0.0, 1.0], [len(one), len(other)]),
        ]
    )
    found = linprog(np.zeros(len(one) + len(other)), A_eq=equations, b_eq=[0, 0, 0, 1, 1], method="highs")
    return found.status == 0


def test_agrees_with_a_linear_programme():
    rng = np.random.default_rng(1)
    answers = []
    for _ in range(200):
        one = rng.normal(size=(rng.integers(1, 60), 3)) * rng.uniform(0.1, 1, 3)
        other = rng.normal(size=(rng.integers(1, 60), 3)) * rng.uniform(0.1, 1, 3) + rng.normal(size=3)
        answers.append(meet(one, other, guess=tuple(rng.normal(size=3))))
        assert answers[-1] == meet_by_linear_programme(one, other)
    assert 20 < sum(answers) < 180


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_cubes_near_to_touching(scale):
    turn = Rotation.from_euler("xyz", [0.3, -0.7, 1.1])
    for direction in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]):
        for step, expected in ((0.999999, True), (1.000001, False)):
            shifted = CUBE + step * np.array(direction)
            assert meet(scale * turn.apply(CUBE), scale * turn.apply(shifted)) is expected


def test_one_inside_the_other_and_a_cloud_with_itself():
    assert meet(CUBE, 0.2 * CUBE + 0.4)
    assert meet(CUBE, CUBE)
    assert meet(CUBE[:1], CUBE[:1])


def test_flat_clouds():
    square = CUBE[CUBE[:, 2] == 0]
    assert meet(square, square + np.array([0.5, 0.5, 0.0]))
    assert not meet(square, square + np.array([0.5, 0.5, 1e-3]))
    assert not meet(square, square + np.array([1.5, 0.0, 0.0]))


def test_far_points_carry_a_hull_on():
    away = CUBE + np.array([10.0, 0.0, 0.0])
    assert not meet(CUBE, away)
    assert meet(CUBE, away, one_far=np.array([[[100.0]], [[0.5]], [[0.5]]]))
    assert not meet(CUBE, away, one_far=np.array([[[0.5]], [[100.0]], [[0.5]]]))


def distance(one, other, enough=np.inf):
    sliced = [
        slice_spokes(np.ascontiguousarray(cloud.T)[:, None, :], np.array([0, len(cloud)]))
        for cloud in (one, other)
    ]
    return hull_distance(sliced[0], NONE, sliced[1], NONE, (1.0, 0.2, -0.1), enough)


def test_distance_of_hulls_is_that_of_a_quadratic_programme():
    rng = np.random.default_rng(4)
    for _ in range(30):
        one, other = rng.normal(size=(2, 12, 3)) * [1.0, 1.0, 0.2] + np.array([[[0.0] * 3], [[2, 3, 1.0]]])
        apart = minimize(
            lambda shares, one=one, other=other: np.sum((shares[:12] @ one - shares[12:] @ other) ** 2),
            np.full(24, 1 / 12),
            bounds=[(0, 1)] * 24,
            constraints=[
                {"type": "eq", "fun": lambda shares: shares[:12].sum() - 1},
                {"type": "eq", "fun": lambda shares: shares[12:].sum() - 1},
            ],
        )
        true = np.sqrt(max(apart.fun, 0.0))
        assert 0.985 * true - 1e-3 <= distance(one, other) <= true + 1e-6
        assert distance(one, other, enough=0.1 * true) <= true + 1e-6


def test_hulls_bound_the_gap_where_the_samples_are_sparse():
    """Two needles of samples side by side: no samples are as near as the needles."""
    along = np.linspace(0.0, 10.0, 4)[:, None] * [0.0, 0.0, 1.0]
    beside = along + np.array([1.0, 0.0, 10.0 / 6.0])
    assert distance(along, beside) == pytest.approx(1.0, rel=0.01)
