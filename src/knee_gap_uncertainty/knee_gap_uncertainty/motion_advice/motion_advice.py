"""Advice on motion: how far and where to the scope should move for the wanted certainty of the gap.

The signal-to-noise ratio is not monotone in the travel, so nothing is bisected over the whole range: travel
is scanned in steps from the present lens position, the rays to the present estimate of the points are
synthesised at each, and only the first step that reaches the target is refined. Across a smooth edge its
contour slides over the bone; so the best direction is looked for along the gap only.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from math import inf, isfinite, nan
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from knee_gap_core.node.parameter_rules import broken_rule
from knee_gap_core.values.errors import BadInputError, MeasurementError
from knee_gap_uncertainty.instrument_gap.instrument_gap import (
    Edges,
    edge_points,
    instrument_gap,
    opening_of,
    widest_gap,
    worst_case,
)
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.scale_drift import with_scale_drift
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.two_view.angle_sets import INTERVAL_SIGNS, SIGNS
from knee_gap_uncertainty.two_view.translation_volume import displacements

Floats = npt.NDArray[np.float64]

STEP = 0.5e-3
REFINEMENTS = 5
# A view is kept about this often along a travel; so many more will be there at its end.
VIEW_SPACING = 0.2e-3
MOST_NEW_VIEWS = 40
# The other sense of the gap must be this much better before the advice turns round.
TURN_ADVANTAGE = 0.2
# So many times in a row a target must be out of reach, or back in it, before the advice reports it.
CONFIRMATIONS = 2


@dataclass(frozen=True)
class AdviceParameters:
    """What the advice aims at. Raises BadInputError for values outside their range."""

    advice_target: Literal["snr", "width"] = field(
        default="snr",
        metadata={
            "description": "what is asked for: snr, or the width of the confidence interval",
            "choices": ("snr", "width"),
        },
    )
    target_snr: float = field(
        default=4.0,
        metadata={"description": "signal-to-noise ratio asked for [-]", "range": (0.1, 1000.0)},
    )
    target_width: float = field(
        default=0.5e-3,
        metadata={"description": "width of the confidence interval asked for [m]", "range": (1e-6, 0.1)},
    )
    farthest_travel: float = field(
        default=0.01,
        metadata={"description": "farthest further travel that is considered [m]", "range": (0.001, 0.03)},
    )

    def __post_init__(self) -> None:
        if rule := broken_rule(self):
            raise BadInputError(rule)

    @property
    def target(self) -> float:
        """The number asked for, in its own unit."""
        return self.target_snr if self.advice_target == "snr" else self.target_width


class Situation(NamedTuple):
    """What is known at an image; all in the frame of the poses, `frame_id` is that of the lens.

    `first_lens`, `lens` (3,) [m] where the track began and where it is, `reference_lens` (3,) [m] that of the
    view with which the bounds are made; `rotation` (3, 3) maps lens coordinates to that frame; `points`
    (2, 3) [m] as estimated; `angular_error` [rad], `image_error` [rad], the part of it that is the image's
    alone, and `translation_error` [m] bound the errors; `views` are those of the track, the present one last;
    `direction` (3,) is the unit vector of the present travel. `scale_drift` and `correlated_error_share` are
    the estimator's. `edges` are those of the opening that the present lens sees.
    """

    stamp_ns: int
    frame_id: str
    track_id: int
    first_lens: Floats
    reference_lens: Floats
    lens: Floats
    rotation: Floats
    points: Floats
    direction: Floats
    angular_error: float
    image_error: float
    translation_error: float
    interval: Literal["worst_case", "paper"]
    apex: Literal["first", "second", "best"]
    confidence_level: float
    views: Views
    edges: Edges
    scale_drift: float = 0.0
    correlated_error_share: float = 0.0


class Prospect(NamedTuple):
    """What travel along one direction (3,) promises; the direction is in the lens frame.

    `travel` [m] reaches the target: 0 where it is reached, NaN where none does. `best` is the best value
    there is this way, in the target's unit, at `best_travel` [m].
    """

    direction: Floats
    travel: float
    best: float
    best_travel: float

    @property
    def reachable(self) -> bool:
        """Whether some travel this way reaches the target."""
        return isfinite(self.travel)


class MotionAdvice(NamedTuple):
    """Advice at an image: along the present direction, and along the gap; in the lens frame."""

    stamp_ns: int
    frame_id: str
    track_id: int
    present: Prospect
    best: Prospect


def snr_after(situation: Situation, offset: Floats, places: Floats | None = None) -> float:
    """Signal-to-noise ratio of the gap `offset` (3,) [m] further on; 0 where it is unbounded.

    `places` are those of `places_of`, if they are known already.
    """
    lens = situation.lens + offset
    if not float(np.linalg.norm(lens - situation.reference_lens)) > 2.0 * situation.translation_error:
        return 0.0
    edges = edges_after(situation, lens, places)
    bearings = unit(situation.points - lens)
    opening = opening_of(bearings, edges.bearings)
    gap_min, gap_max = worst_case(
        situation.reference_lens - lens,
        bearings,
        unit(situation.points - situation.reference_lens),
        opening,
        edges,
        situation.angular_error,
        situation.image_error,
        displacements(situation.translation_error, 1),
        SIGNS[INTERVAL_SIGNS[situation.interval]],
    )
    return widest_gap(situation.points, lens, opening, edges) / (gap_max - gap_min)


def width_after(situation: Situation, offset: Floats, places: Floats | None = None) -> float:
    """Width of the gap's confidence interval [m] `offset` (3,) [m] further on; infinite where refused.

    `places` as in `snr_after`.
    """
    try:
        views = views_after(situation, offset)
        fitted = fit(views)
    except MeasurementError:
        return inf
    fitted = with_scale_drift(
        fitted, views, situation.first_lens, situation.scale_drift, situation.correlated_error_share
    )
    lens = situation.lens + offset
    if not np.isfinite(fitted.points).all():
        return inf
    edges = edges_after(situation, lens, places)
    opening = opening_of(unit(situation.points - lens), edges.bearings)
    radius = float(ndtri(0.5 + 0.5 * situation.confidence_level))
    found = instrument_gap(fitted, lens, opening, edges, radius)
    return found.upper - found.lower


def places_of(situation: Situation) -> Floats:
    """Where the edges lie on the tissue (2, 3) [m]."""
    opening = opening_of(unit(situation.points - situation.lens), situation.edges.bearings)
    return edge_points(situation.lens, situation.points, opening, situation.edges)


def edges_after(situation: Situation, lens: Floats, places: Floats | None = None) -> Edges:
    """The edges as another lens (3,) [m] sees them: at the same places of the tissue, as far as they go."""
    if places is None:
        places = places_of(situation)
    return situation.edges._replace(bearings=unit(places - lens))


def views_after(situation: Situation, offset: Floats) -> Views:
    """The views there will be: those of the track, and more like the present one, without noise."""
    views = situation.views
    travel = float(np.linalg.norm(offset))
    count = min(MOST_NEW_VIEWS, int(np.ceil(travel / VIEW_SPACING)))
    ahead = situation.lens + np.linspace(0.0, 1.0, count + 1)[1:, None] * offset
    positions = np.concatenate([views.lens_positions, ahead])
    towards = situation.points - positions[:, None, :]

    def extended(values: Floats) -> Floats:
        return np.concatenate([values, np.repeat(values[-1:], count, axis=0)])

    return Views(
        lens_positions=positions,
        bearings=unit(towards),
        bearing_covariances=across(unit(towards), views.bearing_covariances, count),
        lens_covariances=extended(views.lens_covariances),
        rotation_covariances=extended(views.rotation_covariances),
        common_share=views.common_share,
        lens_rotations=None if views.lens_rotations is None else extended(views.lens_rotations),
    )


def across(bearings: Floats, covariances: Floats, count: int) -> Floats:
    """Round covariances as large as the given ones, null along the bearings; `count` more of the last."""
    variances = np.trace(covariances, axis1=-2, axis2=-1) / 2.0
    variances = np.concatenate([variances, np.repeat(variances[-1:], count, axis=0)])
    planes = np.eye(3) - bearings[..., :, None] * bearings[..., None, :]
    return np.asarray(variances[..., None, None] * planes)


def unit(vectors: Floats) -> Floats:
    """Vectors (..., 3) of length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def along_the_gap(situation: Situation) -> Floats:
    """Unit vector (3,) along the gap in the frame of the poses: across the view and the line of the points.

    Raises BadInputError where the points lie one behind the other, and there is no such direction.
    """
    middle = situation.points.mean(axis=0) - situation.lens
    normal = np.cross(middle, situation.points[1] - situation.points[0])
    length = float(np.linalg.norm(normal))
    if not length > 1e-9 * float(np.linalg.norm(middle)):
        raise BadInputError("the points lie one behind the other: there is no direction along the gap")
    return np.asarray(normal / length)


def scan(
    value_after: Callable[[float], float], target: float, farthest: float, *, more_is_better: bool
) -> Iterator[tuple[float, float, float] | None]:
    """Yield None after each evaluation, and at last (travel, best, best_travel).

    A generator, so that images can be answered between the pieces of the scan.
    """

    def reached(value: float) -> bool:
        return value >= target if more_is_better else value <= target

    best, best_travel, before = (-inf if more_is_better else inf), 0.0, 0.0
    for travel in np.append(np.arange(0.0, farthest, STEP), farthest):
        value = value_after(float(travel))
        yield None
        if reached(value):
            low, high = before, float(travel)
            for _ in range(REFINEMENTS if travel > 0.0 else 0):
                middle = 0.5 * (low + high)
                value_in_between = value_after(middle)
                yield None
                low, high = (low, middle) if reached(value_in_between) else (middle, high)
            yield high, value, float(travel)
            return
        if (value > best) == more_is_better and value != best:
            best, best_travel = value, float(travel)
        before = float(travel)
    yield nan, best, best_travel


class MotionAdvisor:
    """Makes advice out of situations, one at a time and in small pieces, and keeps it from flickering."""

    def __init__(self, parameters: AdviceParameters | None = None) -> None:
        self.parameters = parameters or AdviceParameters()
        self._last: MotionAdvice | None = None
        self._changes = {"present": 0, "best": 0}

    def advise(self, situation: Situation) -> MotionAdvice:
        """Advice at once."""
        advice = None
        for advice in self.in_pieces(situation):  # noqa: B007  # the last one is the answer
            pass
        assert advice is not None
        return advice

    def in_pieces(self, situation: Situation) -> Generator[MotionAdvice | None, None, None]:
        """Yield None after each evaluation, of at most a few milliseconds, and at last the advice."""
        present = nowhere(situation.direction @ situation.rotation)
        if np.isfinite(situation.direction).all():
            present = yield from self._prospect(situation, situation.direction)
        try:
            along = along_the_gap(situation)
        except BadInputError:
            best = present
        else:
            forth = yield from self._prospect(situation, along)
            back = yield from self._prospect(situation, -along)
            best = self._better(forth, back)
        yield self._steady(
            MotionAdvice(situation.stamp_ns, situation.frame_id, situation.track_id, present, best)
        )

    def _prospect(self, situation: Situation, direction: Floats) -> Generator[None, None, Prospect]:
        """Scan one direction; yields None, returns the Prospect."""
        is_snr = self.parameters.advice_target == "snr"
        value_after, places = snr_after if is_snr else width_after, places_of(situation)
        pieces = scan(
            lambda travel: value_after(situation, travel * direction, places),
            self.parameters.target,
            self.parameters.farthest_travel,
            more_is_better=is_snr,
        )
        for found in pieces:
            if found is not None:
                return Prospect(direction @ situation.rotation, *found)
            yield None
        raise AssertionError("a scan ends with its result")

    def _better(self, forth: Prospect, back: Prospect) -> Prospect:
        """The better sense; the one advised before unless the other is better by far."""
        sign = 1.0 if self.parameters.advice_target == "snr" else -1.0

        def cost(prospect: Prospect) -> float:
            # A reachable target before any that is not; then less travel, or a better best.
            return prospect.travel if prospect.reachable else 1e3 - sign * min(prospect.best, 1e2)

        better, other = (forth, back) if cost(forth) <= cost(back) else (back, forth)
        if self._last is not None and self._last.best.direction @ other.direction > 0.5:
            slightly = other.reachable == better.reachable and (
                cost(other) - cost(better) <= TURN_ADVANTAGE * max(abs(cost(better)), STEP)
            )
            return other if slightly else better
        return better

    def _steady(self, advice: MotionAdvice) -> MotionAdvice:
        """The advice, with a target out of reach or back in it only once that is confirmed."""
        last = self._last if self._last is not None and self._last.track_id == advice.track_id else None
        for name in ("present", "best"):
            new, old = getattr(advice, name), getattr(last, name) if last is not None else None
            if old is None or new.reachable == old.reachable:
                self._changes[name] = 0
                continue
            self._changes[name] += 1
            if self._changes[name] < CONFIRMATIONS:
                advice = advice._replace(**{name: new._replace(travel=old.travel)})
            else:
                self._changes[name] = 0
        self._last = advice
        return advice


def nowhere(direction: Floats) -> Prospect:
    """Prospect of a direction that is not known."""
    return Prospect(direction, nan, nan, nan)
