"""Advice on motion: what it promises comes true, and it does not flicker."""

import math

import numpy as np
import pytest

from knee_gap_core.values.edges import EdgeKind
from knee_gap_core.values.errors import BadInputError
from knee_gap_uncertainty.instrument_gap.instrument_gap import (
    Edges,
    opening_of,
    widest_gap,
    worst_case,
)
from knee_gap_uncertainty.motion_advice.advice_task import PIECES, AdvicePace
from knee_gap_uncertainty.motion_advice.motion_advice import (
    AdviceParameters,
    MotionAdvisor,
    Situation,
    along_the_gap,
    edges_after,
    scan,
    unit,
    width_after,
)
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.two_view.angle_sets import SIGNS
from knee_gap_uncertainty.two_view.translation_volume import displacements

POINTS = np.array([[0.0, -0.002, 0.010], [0.0, 0.002, 0.010]])
# Where faces at 45 degrees to the lines of sight of a lens at the origin would end.
EDGES = np.array([[0.0, -0.00165, 0.01026], [0.0, 0.00165, 0.01026]])
SIDEWAYS = np.array([1.0, 0.0, 0.0])


def situation(
    travelled: float = 0.002, angular_error: float = math.radians(1.0), direction: np.ndarray = SIDEWAYS
) -> Situation:
    """A lens that came `travelled` along the gap and looks straight at it."""
    count = 8
    lens = np.linspace(0.0, travelled, count)[:, None] * SIDEWAYS
    bearings = unit(POINTS - lens[:, None, :])
    planes = np.eye(3) - bearings[..., :, None] * bearings[..., None, :]
    views = Views(
        lens_positions=lens,
        bearings=bearings,
        bearing_covariances=math.radians(0.3) ** 2 * planes,
        lens_covariances=np.tile((2e-5) ** 2 * np.eye(3), (count, 1, 1)),
        rotation_covariances=np.tile((4e-5) ** 2 * np.eye(3), (count, 1, 1)),
        lens_rotations=np.tile(np.eye(3), (count, 1, 1)),
    )
    return Situation(
        stamp_ns=0,
        frame_id="arthroscope_optical",
        track_id=1,
        first_lens=lens[0],
        reference_lens=lens[0],
        lens=lens[-1],
        rotation=np.eye(3),
        points=POINTS,
        direction=direction,
        angular_error=angular_error,
        image_error=0.5 * angular_error,
        translation_error=3.7e-5,
        interval="worst_case",
        apex="best",
        confidence_level=0.95,
        views=views,
        edges=Edges(unit(EDGES - lens[-1]), np.full(2, 1e-3), 3e-3, (EdgeKind.RIM, EdgeKind.RIM)),
    )


def snr_at(now: Situation, lens: np.ndarray) -> float:
    """The ratio that the bounds of the gap really have from a lens that sees the same edges."""
    edges = edges_after(now, lens)
    opening = opening_of(unit(POINTS - lens), edges.bearings)
    lower, upper = worst_case(
        now.first_lens - lens,
        unit(POINTS - lens),
        unit(POINTS - now.first_lens),
        opening,
        edges,
        now.angular_error,
        now.image_error,
        displacements(now.translation_error, 1),
        SIGNS["all"],
    )
    return widest_gap(POINTS, lens, opening, edges) / (upper - lower)


def test_advised_travel_reaches_the_target_and_less_does_not() -> None:
    now = situation()
    found = MotionAdvisor(AdviceParameters(target_snr=3.0)).advise(now).present
    assert 0.0 < found.travel < 0.01
    assert snr_at(now, now.lens + found.travel * SIDEWAYS) >= 3.0
    assert snr_at(now, now.lens + (found.travel - 1e-4) * SIDEWAYS) < 3.0


def test_target_that_is_reached_needs_no_travel() -> None:
    assert MotionAdvisor(AdviceParameters(target_snr=0.2)).advise(situation(0.005)).present.travel == 0.0


def test_out_of_reach_is_told_with_the_best_there_is() -> None:
    now = situation()
    found = MotionAdvisor(AdviceParameters(target_snr=500.0)).advise(now).present
    assert not found.reachable
    everywhere = [snr_at(now, now.lens + t * SIDEWAYS) for t in np.arange(0.0, 0.01001, 0.5e-3)]
    assert found.best == pytest.approx(max(everywhere))
    assert snr_at(now, now.lens + found.best_travel * SIDEWAYS) == pytest.approx(found.best)


def test_best_direction_lies_along_the_gap_and_beats_travel_across_it() -> None:
    across_it = np.array([0.0, 0.0, 1.0])
    now = situation(direction=across_it)
    advice = MotionAdvisor(AdviceParameters(target_snr=3.0)).advise(now)
    assert advice.best.direction @ (POINTS[1] - POINTS[0]) == pytest.approx(0.0, abs=1e-12)
    assert advice.best.direction @ (POINTS.mean(axis=0) - now.lens) == pytest.approx(0.0, abs=1e-12)
    assert advice.best.direction @ SIDEWAYS > 0.0  # on, not back to where the track began
    assert advice.best.travel <= (advice.present.travel if advice.present.reachable else math.inf)
    assert np.linalg.norm(advice.present.direction) == pytest.approx(1.0)


def test_direction_is_told_in_the_lens_frame() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    advice = MotionAdvisor().advise(situation()._replace(rotation=quarter))
    assert advice.present.direction == pytest.approx(quarter.T @ SIDEWAYS)


def test_width_of_the_interval_as_target() -> None:
    now = situation(0.0005)  # so short a travel leaves most of the width to the points
    target = 0.75 * width_after(now, 0.0 * SIDEWAYS)
    parameters = AdviceParameters(advice_target="width", target_width=target)
    found = MotionAdvisor(parameters).advise(now).present
    assert found.reachable
    assert width_after(now, found.travel * SIDEWAYS) <= target
    assert width_after(now, 0.7 * found.travel * SIDEWAYS) > target


def test_a_width_that_is_promised_has_in_it_what_lasts_over_a_track() -> None:
    offset = 0.001 * SIDEWAYS
    plain = width_after(situation(), offset)
    assert width_after(situation()._replace(correlated_error_share=1.0), offset) > 1.02 * plain
    assert width_after(situation()._replace(scale_drift=0.02), offset) > 1.02 * plain


def test_value_that_rises_and_falls_is_not_bisected_over_its_peak() -> None:
    peak = [
        found for found in scan(lambda t: 5.0 - abs(t - 0.003) * 1e3, 4.9, 0.01, more_is_better=True) if found
    ]
    assert peak[0][0] == pytest.approx(0.0029, abs=2e-5)


def test_work_comes_in_pieces_and_ends_with_the_advice() -> None:
    pieces = list(MotionAdvisor().in_pieces(situation()))
    assert pieces[-1] is not None
    assert pieces[:-1] == [None] * (len(pieces) - 1)
    assert len(pieces) > 20


def test_reach_is_told_otherwise_only_once_confirmed() -> None:
    advisor = MotionAdvisor(AdviceParameters(target_snr=3.0))
    near, far = situation(), situation(angular_error=math.radians(8.0))
    assert advisor.advise(near).present.reachable
    assert advisor.advise(far).present.reachable
    assert not advisor.advise(far).present.reachable
    assert not advisor.advise(near).present.reachable
    assert advisor.advise(near).present.reachable


def test_points_one_behind_the_other_have_no_direction_along_the_gap() -> None:
    behind = situation()._replace(points=np.array([[0.002, 0.0, 0.010], [0.002, 0.0, 0.014]]))
    with pytest.raises(BadInputError, match="one behind the other"):
        along_the_gap(behind)


@pytest.mark.parametrize(
    "bad", [{"target_snr": 0.0}, {"advice_target": "luck"}, {"farthest_travel": math.inf}]
)
def test_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(BadInputError, match=next(iter(bad))):
        AdviceParameters(**bad)  # type: ignore[arg-type]


def test_advice_that_takes_long_rests_and_comes_back():
    pace = AdvicePace(0.01)
    assert pace.next() == PIECES
    pace.spent(0.08)
    turns = []
    for _ in range(40):
        turns.append(pace.next())
        pace.spent(0.0)
    # Eight turns' time was taken: four times as long nothing is done, then one piece, then more again.
    assert turns[:32] == [0] * 32
    assert turns[32:36] == [1, 2, 3, 4]
