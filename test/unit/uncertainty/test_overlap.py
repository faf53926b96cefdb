"""Whether hulls meet: against linear programming, and on shapes whose answer is known."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from knee_gap_uncertainty.overlap import hulls_meet
from knee_gap_uncertainty.slices import slice_spokes

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
