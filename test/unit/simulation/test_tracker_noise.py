"""What the simulated tracker reports has the stated error, at the lens."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.hand_motion import Hand, HandMotion, TravelDirection, minimum_jerk
from knee_gap_simulation.scope.tracker import TrackerNoise, tracked_body

COUNT = 20_000


@pytest.fixture(scope="module")
def errors() -> tuple[np.ndarray, np.ndarray]:
    true = HandMotion(travel=0.008, depth=0.01, seed=5).poses(np.linspace(0.0, 6.0, COUNT))
    T_body_lens = Scope().body_to_lens()
    body = tracked_body(true, T_body_lens, TrackerNoise(), np.random.default_rng(11))
    lens = body @ T_body_lens
    turn = Rotation.from_matrix((inverse(true) @ lens)[:, :3, :3]).as_rotvec()
    return lens[:, :3, 3] - true[:, :3, 3], turn


def test_errors_at_the_lens_have_the_papers_length(errors):
    shift, turn = errors
    # The mean of n squared lengths of a 3D Gaussian scatters by sqrt(2 / 3n) of itself: five of those.
    tolerance = 5.0 * np.sqrt(2.0 / (3.0 * COUNT)) / 2.0
    assert np.sqrt((shift**2).sum(axis=1).mean()) == pytest.approx(0.0367e-3, rel=tolerance)
    assert np.degrees(np.sqrt((turn**2).sum(axis=1).mean())) == pytest.approx(0.004, rel=tolerance)


def test_errors_are_white_and_equal_on_all_axes(errors):
    for error in errors:
        sigma = np.sqrt((error**2).sum(axis=1).mean() / 3.0)
        assert np.abs(error.mean(axis=0)).max() < 5.0 * sigma / np.sqrt(COUNT)
        correlation = np.corrcoef(np.hstack([error[1:], error[:-1]]).T)
        assert np.abs(correlation - np.eye(6)).max() < 5.0 / np.sqrt(COUNT)


def test_without_noise_the_lens_is_where_it_is():
    true = HandMotion(travel=0.008, depth=0.01, seed=5).poses(np.linspace(0.0, 1.0, 10))
    T_body_lens = Scope().body_to_lens()
    body = tracked_body(true, T_body_lens, TrackerNoise(0.0, 0.0), np.random.default_rng(1))
    assert np.abs(body @ T_body_lens - true).max() < 1e-15


def test_the_view_is_tipped_by_the_oblique_angle():
    scope = Scope()
    shaft, view = scope.body_to_shaft()[:3, 2], scope.body_to_lens()[:3, 2]
    assert np.degrees(np.arccos(shaft @ view)) == pytest.approx(30.0, abs=1e-9)
    # to the top of the picture: up is -y
    assert (scope.body_to_shaft()[:3, :3].T @ view)[1] == pytest.approx(-0.5, abs=1e-12)


@pytest.mark.parametrize("direction", list(TravelDirection))
def test_a_hand_starts_still_travels_the_distance_and_comes_back(direction):
    hand = Hand(tremor=0.0, drift=0.0)
    motion = HandMotion(travel=0.008, depth=0.01, direction=direction, hand=hand, seed=2)
    position = motion.poses(np.linspace(0.0, 5.6, 561))[:, :3, 3]
    along = position[:, direction.axis] - position[0, direction.axis]
    assert np.abs(along[:30]).max() < 1e-12
    assert along.max() == pytest.approx(0.008, abs=1e-12)
    assert along[-1] == pytest.approx(0.0, abs=1e-5)
    others = np.delete(position, direction.axis, axis=1)
    assert np.abs(others - others[0]).max() < 1e-12


def test_tremor_lies_between_8_and_12_hz():
    hand = Hand(drift=0.0, still_s=100.0)
    time = np.arange(0.0, 20.0, 0.01)
    position = HandMotion(travel=0.0, depth=0.01, hand=hand, seed=4).poses(time)[:, :3, 3]
    power = np.abs(np.fft.rfft(position - position.mean(axis=0), axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(time), 0.01)
    band = (frequency > 7.8) & (frequency < 12.2)
    assert power[band].sum() > 0.98 * power.sum()
    length = np.sqrt(((position - position.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert length == pytest.approx(0.05e-3, rel=0.05)


def test_minimum_jerk_starts_and_ends_at_rest():
    phase = np.linspace(0.0, 1.0, 2001)
    speed = np.gradient(minimum_jerk(phase), phase)
    assert speed[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-5)
    assert speed.max() == pytest.approx(15.0 / 8.0, rel=1e-5)


def test_impossible_motions_are_refused():
    with pytest.raises(SimulationError, match=r"depth.*0\.5"):
        HandMotion(travel=0.0, depth=0.5)
    with pytest.raises(SimulationError, match="translation_error"):
        TrackerNoise(translation_error=-1.0)
