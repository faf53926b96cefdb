"""Acceptance of an estimate: one ordered table of rules, the first broken one is why it is not VALID.

A rule is a reason, the status that it gives, a predicate over the facts that are known of an image, and what
may still be reported if it is broken. An image is judged again as more becomes known of it (edges, pose,
views, bounds); a predicate over facts that are not known yet is False. A new rule is a Reason and a row here,
and its limit in `estimator_parameters`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import NamedTuple

import numpy as np

from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.errors import (
    BaselineTooShortError,
    CheiralityError,
    EpipoleError,
    MeasurementError,
    UnderconstrainedError,
)
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.poses import LensPose
from knee_gap_core.values.rejection import Rejection
from knee_gap_uncertainty.estimator_parameters import EstimatorParameters
from knee_gap_uncertainty.inputs.pose_buffer import PoseRefusal
from knee_gap_uncertainty.inputs.scope_rotations import RotationRefusal
from knee_gap_uncertainty.joint_motion.joint_motion import Finding

# Along the line of the ray from the other view, one of two views may be wrong by any amount.
FEWEST_VIEWS_TO_CHECK = 3
# A live clock that is not set differs by seconds or hours; stamps older than this [s] are of a recording.
AGE_OF_A_RECORDING = 86_400.0


class Reason(StrEnum):
    """Why an estimate is not VALID, in constant words: what is counted must be bounded."""

    FAULT = "an input made the estimator fail"
    NOTHING_YET = "no edges received yet"
    SILENCE = "no gap_edges received: check segmentation_node and the camera"
    NOT_SEEN = "the image gave no usable edges"
    HIDDEN = "a point is hidden in the image: its bearing is a prediction, not a measurement"
    BAD_EDGES = "the edges contain invalid numbers"
    FAR_FROM_CLOCK = "the image's stamp is more than max_clock_offset from this node's clock"
    LATE = "the image is later than max_delay: is the machine overloaded?"
    NO_POSE_FOLLOWS = "no lens pose follows the image"
    NO_POSE = "no lens pose is near enough to the image's stamp"
    NO_TURN = RotationRefusal.NONE_NEAR.value
    CALIBRATION = "the calibrations of the nodes cannot be used"
    LEG_LOST = "the leg body is not tracked"
    UNKNOWN_MOTION = (
        "the clock is uncertain, and the lens's speed at the image is unknown: too few lens poses near it"
    )
    LEG_MOVED = "the leg body moved"
    CONTRADICTED = Finding.CONTRADICTION.value
    MOVED = Finding.MOVED.value
    NO_NUMBERS = "the views or the calibration's error contain unusable numbers"
    NO_SECTION = "the edges of the opening at the section cannot be used"
    AT_BORDER = "an edge of the opening lies beyond the border of the field of view"
    HARDLY_MOVED = "the scope has hardly moved"
    ALONG_THE_TRAVEL = "a point lies in the direction of the scope's travel"
    RAYS_MEET_BEHIND = "the rays to a point do not meet in front of the scope"
    PARALLEL_RAYS = "the rays to a point are parallel"
    UNCHECKED = "fewer than three usable views: keep the scope moving"
    UNBOUNDED = "the admitted errors leave the gap unbounded"
    UNCERTAIN_DEPTH = "the depth of a point is too uncertain"
    SHORT_BASELINE = "the scope has moved too little for the distance of the points"
    GAP_TOO_LARGE = "the gap is larger than any joint's"
    BOUND_TOO_LARGE = "the largest gap that the errors admit is larger than any joint's"
    BOUNDS_DISAGREE = "the estimate from all views lies outside the bounds from two of them"


class Kept(Enum):
    """What is reported of an image that breaks a rule: nothing, or lower bounds, the upper ones infinite."""

    NOTHING = 0
    LOWER_BOUNDS = 1


@dataclass(frozen=True, eq=False)
class Facts:
    """What is known of one image; the defaults are of what is not known yet.

    `fault`: what raised an exception, in words. `is_silent`: no image came for too long, or none at all so
    far (`is_first_awaited`). `clock_offset` [s] is how far the node's clock is ahead of the image's stamp,
    NaN where stamps are not held to a clock, and `delay` [s] how much longer than it has to the answer
    takes. `pose` and `turn` are those at the image, or
    why there is none. `needs_motion`: the clock has an error. `measured` is the estimate as it would be
    VALID, `section_flaw` why the edges at its section cannot be used, `at_border` that one of them lies at
    the border of the picture, `still_count` the images found still, `distance` [m] that of the farther point
    from the lens.
    """

    parameters: EstimatorParameters
    fault: str = ""
    is_silent: bool = False
    is_first_awaited: bool = False
    edges: GapEdges | None = None
    edges_flaw: str = ""
    clock_offset: float = float("nan")
    delay: float = 0.0
    pose: LensPose | PoseRefusal | None = None
    turn: float | RotationRefusal = 0.0
    calibration_flaw: str = ""
    leg_flaw: str = ""
    needs_motion: bool = False
    leg_moved: bool = False
    finding: Finding | None = None
    error: Exception | None = None
    measured: GapEstimate | None = None
    section_flaw: str = ""
    at_border: bool = False
    depth_refused: bool = False
    still_count: int = 0
    distance: float = float("nan")


class Rule(NamedTuple):
    """A row of the table; `detail` gives the words that are particular to the image."""

    reason: Reason
    status: GapStatus
    is_broken: Callable[[Facts], bool]
    kept: Kept = Kept.NOTHING
    detail: Callable[[Facts], str] = lambda facts: ""


def _raised(*kinds: type[Exception]) -> Callable[[Facts], bool]:
    return lambda facts: isinstance(facts.error, kinds)


def _measured(is_broken: Callable[[GapEstimate, Facts], bool]) -> Callable[[Facts], bool]:
    """A predicate over the measured numbers; False while they are not known."""
    return lambda facts: facts.measured is not None and is_broken(facts.measured, facts)


def _is_far_from_clock(facts: Facts) -> bool:
    """Ahead of the clock no recording is, and behind it only one of another day."""
    limit = facts.parameters.max_clock_offset
    return facts.clock_offset < -limit or limit < facts.clock_offset < AGE_OF_A_RECORDING


def _is_short(estimate: GapEstimate, facts: Facts) -> bool:
    limits = facts.parameters
    return estimate.baseline < max(limits.least_baseline, limits.least_baseline_share * facts.distance)


def _contradicts_bounds(estimate: GapEstimate) -> bool:
    """Whether numbers that are known lie outside their bounds."""
    pairs = (
        (estimate.gap, estimate.gap_min, estimate.gap_max),
        (estimate.point_distance, estimate.point_distance_min, estimate.point_distance_max),
    )
    return any(value < low or value > high for value, low, high in pairs)


RULES: tuple[Rule, ...] = (
    # The image and its stamp.
    Rule(Reason.FAULT, GapStatus.UNKNOWN, lambda f: bool(f.fault), detail=lambda f: f.fault),
    Rule(Reason.NOTHING_YET, GapStatus.UNKNOWN, lambda f: f.is_silent and f.is_first_awaited),
    Rule(Reason.SILENCE, GapStatus.NO_EDGES, lambda f: f.is_silent),
    Rule(
        Reason.NOT_SEEN,
        GapStatus.NO_EDGES,
        lambda f: f.edges is not None and not f.edges.usable,
        detail=lambda f: f.edges_flaw,
    ),
    Rule(Reason.HIDDEN, GapStatus.NO_EDGES, lambda f: f.edges is not None and any(f.edges.hidden)),
    Rule(Reason.BAD_EDGES, GapStatus.NO_EDGES, lambda f: bool(f.edges_flaw), detail=lambda f: f.edges_flaw),
    Rule(Reason.FAR_FROM_CLOCK, GapStatus.OUT_OF_SYNC, _is_far_from_clock),
    Rule(Reason.NO_POSE_FOLLOWS, GapStatus.TRACKING_LOST, lambda f: f.pose is PoseRefusal.NOT_YET),
    Rule(
        Reason.NO_POSE,
        GapStatus.OUT_OF_SYNC,
        lambda f: isinstance(f.pose, PoseRefusal),
        detail=lambda f: str(f.pose),
    ),
    Rule(Reason.LATE, GapStatus.OUT_OF_SYNC, lambda f: f.delay > f.parameters.max_delay),
    Rule(Reason.NO_TURN, GapStatus.OUT_OF_SYNC, lambda f: isinstance(f.turn, RotationRefusal)),
    # What all views of a track rest on.
    Rule(
        Reason.CALIBRATION,
        GapStatus.UNKNOWN,
        lambda f: bool(f.calibration_flaw),
        detail=lambda f: f.calibration_flaw,
    ),
    Rule(Reason.LEG_LOST, GapStatus.TRACKING_LOST, lambda f: bool(f.leg_flaw), detail=lambda f: f.leg_flaw),
    Rule(
        Reason.UNKNOWN_MOTION,
        GapStatus.OUT_OF_SYNC,
        lambda f: f.needs_motion and isinstance(f.pose, LensPose) and not np.isfinite(f.pose.motion).all(),
    ),
    Rule(Reason.LEG_MOVED, GapStatus.JOINT_MOVED, lambda f: f.leg_moved),
    # The views of the track.
    Rule(Reason.CONTRADICTED, GapStatus.UNKNOWN, lambda f: f.finding is Finding.CONTRADICTION),
    Rule(Reason.MOVED, GapStatus.JOINT_MOVED, lambda f: f.finding is Finding.MOVED),
    Rule(Reason.HARDLY_MOVED, GapStatus.INSUFFICIENT_PARALLAX, _raised(BaselineTooShortError)),
    Rule(Reason.ALONG_THE_TRAVEL, GapStatus.INSUFFICIENT_PARALLAX, _raised(EpipoleError)),
    Rule(Reason.RAYS_MEET_BEHIND, GapStatus.INSUFFICIENT_PARALLAX, _raised(CheiralityError)),
    Rule(Reason.PARALLEL_RAYS, GapStatus.INSUFFICIENT_PARALLAX, _raised(UnderconstrainedError)),
    Rule(
        Reason.NO_NUMBERS,
        GapStatus.UNKNOWN,
        _raised(MeasurementError, ArithmeticError, ValueError),
    ),
    # The edges beside the points, and the numbers.
    Rule(
        Reason.NO_SECTION,
        GapStatus.NO_EDGES,
        lambda f: bool(f.section_flaw),
        Kept.LOWER_BOUNDS,
        lambda f: f.section_flaw,
    ),
    Rule(Reason.AT_BORDER, GapStatus.NO_EDGES, lambda f: f.at_border, Kept.LOWER_BOUNDS),
    Rule(
        Reason.UNCHECKED,
        GapStatus.INSUFFICIENT_PARALLAX,
        _measured(lambda _, f: f.still_count < FEWEST_VIEWS_TO_CHECK),
        Kept.LOWER_BOUNDS,
    ),
    Rule(
        Reason.UNBOUNDED,
        GapStatus.INSUFFICIENT_PARALLAX,
        _measured(lambda e, _: not np.isfinite([e.gap_max, e.point_distance_max]).all()),
        Kept.LOWER_BOUNDS,
    ),
    Rule(
        Reason.UNCERTAIN_DEPTH,
        GapStatus.INSUFFICIENT_PARALLAX,
        _measured(lambda e, f: f.depth_refused or not np.isfinite([e.gap, e.confidence_max]).all()),
        Kept.LOWER_BOUNDS,
    ),
    Rule(Reason.SHORT_BASELINE, GapStatus.INSUFFICIENT_PARALLAX, _measured(_is_short), Kept.LOWER_BOUNDS),
    Rule(Reason.GAP_TOO_LARGE, GapStatus.UNKNOWN, _measured(lambda e, f: e.gap > f.parameters.largest_gap)),
    Rule(
        Reason.BOUND_TOO_LARGE,
        GapStatus.INSUFFICIENT_PARALLAX,
        _measured(lambda e, f: e.gap_max > f.parameters.largest_gap),
        Kept.LOWER_BOUNDS,
    ),
    Rule(
        Reason.BOUNDS_DISAGREE,
        GapStatus.UNKNOWN,
        _measured(
            lambda e, _: (
                not e.gap_min <= e.gap <= e.gap_max
                or not e.point_distance_min <= e.point_distance <= e.point_distance_max
            )
        ),
    ),
)


class Verdict(NamedTuple):
    """The status of an image that breaks a rule, why, and what may still be reported of it."""

    status: GapStatus
    rejection: Rejection
    kept: Kept


def judge(facts: Facts) -> Verdict | None:
    """The first rule that the facts break; None where they break none.

    Lower bounds are not kept, whichever rule comes first, if the estimate from all views contradicts them.
    """
    for rule in RULES:
        if rule.is_broken(facts):
            disagree = facts.measured is not None and _contradicts_bounds(facts.measured)
            kept = Kept.NOTHING if disagree else rule.kept
            return Verdict(rule.status, Rejection(rule.reason, rule.detail(facts)), kept)
    return None
