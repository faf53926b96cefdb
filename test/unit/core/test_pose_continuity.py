"""Segments of lens poses: a hand's motion is one segment, a slip that nobody saw begins another."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knee_gap_core.values.pose_continuity import PoseContinuity

PERIOD = 1 / 120  # [s]
ERROR, TURN_ERROR = 0.0367e-3, np.radians(0.004)  # [m], [rad] RMS lengths
COVARIANCE = np.diag(np.repeat([ERROR**2 / 3, TURN_ERROR**2 / 3], 3))
Place = Callable[[float], np.ndarray]


def hand(seed: int) -> Place:
    """Position [m] over time of a hand whose acceleration is 0.5 m/s^2 RMS, with tremor."""
    rng = np.random.default_rng(seed)
    frequencies = 2 * np.pi * np.array([0.2, 0.5, 4.0])
    amplitudes = rng.normal(0, 1, (3, 3)) * np.array([[4e-3], [1e-3], [0.25e-3]])
    phases = rng.uniform(0, 2 * np.pi, (3, 3))
    return lambda t: np.array(
        (amplitudes * np.sin(frequencies[:, None] * t + phases)).sum(axis=0), dtype=float
    )


def segments(
    place: Place, times: np.ndarray, seed: int = 0, world: Rotation | None = None, shift: float = 0.0
) -> list[int]:
    rng = np.random.default_rng(seed)
    world = world or Rotation.identity()
    continuity = PoseContinuity()
    reported: list[int] = []
    for t in times:
        noise, turn = rng.normal(0, ERROR / np.sqrt(3), 3), rng.normal(0, TURN_ERROR / np.sqrt(3), 3)
        position = world.apply(place(t) + noise) + shift
        rotation = world * Rotation.from_rotvec([0.0, 0.3 * np.sin(3 * t), 0.0]) * Rotation.from_rotvec(turn)
        stamp = round(1e9 * t) + 10**18
        reported.append(continuity.take(stamp, "world", position, rotation.as_quat(), COVARIANCE))
    return reported


def slipped(place: Place, since: float, by: np.ndarray) -> Place:
    return lambda t: place(t) + (by if t >= since else 0.0)


def still(_: float) -> np.ndarray:
    return np.zeros(3)


@pytest.mark.parametrize("rate", [60, 120, 240])
def test_a_hand_makes_one_segment(rate: int) -> None:
    times = np.arange(0, 2, 1 / rate)
    # Frames that are lost, one and two at a time.
    times = np.delete(times, list(range(30, len(times), 37)) + [k + 1 for k in range(30, len(times), 74)])
    for seed in range(4):
        assert segments(hand(seed), times, seed)[-1] == 0


@pytest.mark.parametrize("unseen", [0.05, 0.3, 0.5, 1.5])
@pytest.mark.parametrize("size", [0.5e-3, 1e-3, 5e-3, 30e-3])
def test_a_slip_of_a_scope_at_rest_while_it_is_unseen_begins_a_segment(unseen: float, size: float) -> None:
    times = np.concatenate([np.arange(0, 0.5, PERIOD), 0.5 + unseen + np.arange(0, 0.5, PERIOD)])
    for seed in range(4):
        direction = np.random.default_rng(seed).normal(size=3)
        place = slipped(still, 0.5 + unseen / 2, size * direction / np.linalg.norm(direction))
        reported = np.array(segments(place, times, seed))
        assert (reported[times < 0.5] == 0).all()
        assert (reported[times > 0.5] == 1).all()


@pytest.mark.parametrize("size", [0.0, 1e-3, 30e-3])
def test_a_moving_scope_that_was_unseen_for_long_begins_a_segment_wherever_it_comes_back(size: float) -> None:
    times = np.concatenate([np.arange(0, 0.5, PERIOD), 1.0 + np.arange(0, 0.5, PERIOD)])
    for seed in range(4):
        place = hand(seed)
        moved = np.linalg.norm(place(1.0) - place(0.5))
        reported = segments(slipped(place, 0.7, np.array([size, 0.0, 0.0])), times, seed)
        if moved > 1e-3:
            assert reported[-1] == 1


def test_a_scope_that_was_held_still_goes_on() -> None:
    times = np.concatenate([np.arange(0, 0.5, PERIOD), 5.0 + np.arange(0, 0.5, PERIOD)])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        continuity = PoseContinuity()
        reported = [
            continuity.take(
                round(1e9 * t), "world", rng.normal(0, ERROR / np.sqrt(3), 3), [0, 0, 0, 1], COVARIANCE
            )
            for t in times
        ]
        assert reported[-1] == 0
        assert continuity.reason == ""


def test_a_step_in_sight_begins_a_segment() -> None:
    times = np.arange(0, 1, PERIOD)
    for seed in range(4):
        reported = np.array(segments(slipped(hand(seed), 0.5, np.array([0.0, 1.5e-3, 0.0])), times, seed))
        assert reported[times < 0.5].max() == 0
        assert reported[times >= 0.5].min() == 1


def test_a_turn_is_a_step_as_well() -> None:
    continuity = PoseContinuity()
    reported: list[int] = []
    for k in range(40):
        turn = Rotation.from_rotvec([0.0, 0.0, 0.02 if k >= 20 else 0.0])
        reported.append(continuity.take(k * 8_333_333, "world", [0, 0, 0], turn.as_quat(), COVARIANCE))
    assert reported == [0] * 20 + [1] * 20


def test_segments_do_not_depend_on_the_frame_of_the_room() -> None:
    times = np.concatenate([np.arange(0, 0.5, PERIOD), 0.6 + np.arange(0, 0.5, PERIOD)])
    for seed in range(4):
        world = Rotation.from_rotvec(np.random.default_rng(seed).normal(size=3))
        place = slipped(hand(seed), 0.8, np.array([0.0, 2e-3, 0.0]))
        assert segments(place, times, seed) == segments(place, times, seed, world, shift=0.7)


def test_another_frame_and_stamps_that_run_backwards_begin_a_segment() -> None:
    continuity = PoseContinuity()

    def take(stamp: int, frame: str) -> int:
        return continuity.take(stamp, frame, [0, 0, 0], [0, 0, 0, 1], COVARIANCE)

    assert [take(k * 8_333_333, "world") for k in range(1, 9)] == [0] * 8
    assert take(9 * 8_333_333, "femur") == 1
    assert "frame" in continuity.reason
    assert take(9 * 8_333_333, "femur") == 1  # the same once more
    assert take(8_333_333, "femur") == 2
    assert "backwards" in continuity.reason


def test_a_slow_tracker_is_followed_once_its_period_is_known():
    continuity = PoseContinuity()
    segments = []
    for k in range(40):
        seconds = k / 30.0
        place = np.array([0.05, 0.0, 0.02]) * seconds
        segments.append(
            continuity.take(round(1e9 * seconds), "world", place, [0.0, 0.0, 0.0, 1.0], 1e-12 * np.eye(6))
        )
    assert len(set(segments[3:])) == 1


def test_one_long_gap_is_not_taken_for_the_period_of_a_slow_tracker():
    continuity = PoseContinuity()
    times = [*np.arange(0.0, 0.5, 1 / 120), *np.arange(0.6, 1.0, 1 / 120)]
    segments = [
        continuity.take(
            round(1e9 * t), "world", [0.02 * t, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], 1e-12 * np.eye(6)
        )
        for t in times
    ]
    assert segments[0] != segments[-1]
