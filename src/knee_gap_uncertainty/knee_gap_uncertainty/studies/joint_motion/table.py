"""joint_motion_table: what the test for joint motion detects, and how often it alarms where nothing moves."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import degrees, radians
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_uncertainty.joint_motion.joint_motion import Finding, JointMotionTest
from knee_gap_uncertainty.joint_motion.motion_statistics import Observations, motion_statistics, observations
from knee_gap_uncertainty.multi_view.keyframe_window import ViewWindow
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit, fit
from knee_gap_uncertainty.multi_view.views import Views
from knee_gap_uncertainty.studies.joint_motion.simulated_motion import Situation, simulate

DEVIATIONS_DEG = (0.1, 0.5, 1.18)
HEADER = "{:8}  {:22}  {:12}  {:20}  {:>7}  {:>6}  {:>9}  {:>6}"
HEADINGS = (
    ("std of a", "errors of", "travel", "event", "ended", "tracks", "1st image", "images"),
    ("bearing", "the bearings", "", "", "before", "ended", "refused", "to end"),
)


class Outcome(NamedTuple):
    """One track: images from the event (or the start) to the end of the track, -1 where it did not end.

    `too_early`: whether it ended before the event, which is a false alarm and no detection.
    `first_refused`: whether the first image of the event was already refused. `refused`: images refused.
    `statistics`: largest `first` and `shift` [-].
    """

    delay: int
    too_early: bool
    first_refused: bool
    refused: int
    statistics: tuple[float, float]


class Row(NamedTuple):
    """A line of the table: shares of the tracks [-], and the median delay in images.

    `ended` and `first_refused` are shares of the tracks that did not end before the event.
    """

    situation: Situation
    too_early: float
    ended: float
    first_refused: float
    delay: float


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = Parser(prog="joint_motion_table", description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="tracks per line (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default 0)")
    parser.add_argument("--images", type=int, default=600, help="images per track (default 600)")
    parser.add_argument("--only", choices=("still", "moved"), help="one half of the table")
    options = parser.parse_args(argv)
    for name, least in (("runs", 1), ("seed", 0), ("images", 20)):
        if getattr(options, name) < least:
            print(f"joint_motion_table: --{name} must be at least {least}", file=sys.stderr)
            return 2
    still, moved = list(still_situations()), list(moved_situations())
    chosen = {"still": still, "moved": moved}.get(options.only, still + moved)
    print(f"{options.runs} tracks of {options.images} images a line, seed {options.seed}")
    for heading in HEADINGS:
        print(HEADER.format(*heading))
    still_ends = []
    for number, situation in enumerate(tqdm(chosen, unit="line", disable=not sys.stderr.isatty())):
        rng = np.random.default_rng([options.seed, number])
        row = measured(situation, [follow(situation, options.images, rng) for _ in range(options.runs)])
        if not situation.event:
            still_ends.append(row.ended)
        tqdm.write(line(row))
    if still_ends:
        tracks = options.runs * len(still_ends)
        print(f"false alarms: {100 * np.mean(still_ends):.2f} % of {tracks} tracks in which nothing moved")
    return 0


def still_situations() -> Iterator[Situation]:
    """Tracks that must not be ended."""
    for travel in ("out", "out and back", "fast", "rest"):
        for share in (0.0, 0.5, 1.0):
            for bounded in (False, True):
                yield Situation(travel, common_share=share, bounded=bounded)
    for deviation_deg in DEVIATIONS_DEG:
        for travel in ("out", "rest"):
            yield Situation(travel, radians(deviation_deg), common_share=0.5)


def moved_situations() -> Iterator[Situation]:
    """Tracks that must end: a joint that moves, an edge tracker that jumps."""
    for deviation_deg in DEVIATIONS_DEG:
        base = Situation(deviation=radians(deviation_deg))
        for event in ("across", "along travel", "along ray"):
            for size in (0.5e-3, 1e-3):
                yield replace(base, event=event, size=size, event_images=30)
    for deviation_deg in (0.05, 0.1, 0.2):
        for jump_deg in (1.0, 3.0, 5.0):
            yield Situation(
                deviation=radians(deviation_deg), event="edge", size=radians(jump_deg), event_images=10**6
            )


def follow(situation: Situation, image_count: int, rng: np.random.Generator) -> Outcome:
    """Run the test along one simulated track, on the views that a track keeps."""
    views, event_at = simulate(situation, image_count, rng)
    observed = observations(views)
    test, window = JointMotionTest(), ViewWindow()
    kept: list[int] = []
    passing: list[int] = []
    fitted: MultiViewFit | None = None
    refused, first_refused, largest = 0, False, (0.0, 0.0)
    for i in range(image_count):
        chosen = [*kept, *passing, i]
        found = motion_statistics(Observations(*(values[chosen] for values in observed)), fitted)
        largest = (max(largest[0], found.first), max(largest[1], found.shift))
        finding = test.decide(found)
        first_refused |= i == event_at and finding is not Finding.STILL
        if finding is Finding.MOVED:
            too_early = bool(situation.event) and i < event_at
            begin = event_at if i >= event_at else 0
            return Outcome(i - begin + 1, too_early, first_refused, refused, largest)
        if finding is Finding.CONTRADICTION:
            refused += 1
        elif window.add(selected(views, [i])):
            # The window never fills up on these travels.
            kept, passing = [*kept, i], []
            fitted = fit(selected(views, kept)) if len(kept) > 1 else None
        else:
            passing = [i]
    return Outcome(-1, False, first_refused, refused, largest)


def selected(views: Views, chosen: Sequence[int]) -> Views:
    """Some of the views."""
    assert views.lens_rotations is not None
    return Views(
        views.lens_positions[chosen],
        views.bearings[chosen],
        views.bearing_covariances[chosen],
        views.lens_covariances[chosen],
        views.rotation_covariances[chosen],
        views.common_share,
        views.lens_rotations[chosen],
    )


def measured(situation: Situation, outcomes: Sequence[Outcome]) -> Row:
    """Shares of the outcomes."""
    in_time = [outcome for outcome in outcomes if not outcome.too_early]
    delays = [outcome.delay for outcome in in_time if outcome.delay > 0]
    count = max(len(in_time), 1)
    return Row(
        situation,
        too_early=1.0 - len(in_time) / len(outcomes),
        ended=len(delays) / count,
        first_refused=sum(outcome.first_refused for outcome in in_time) / count,
        delay=float(np.median(delays)) if delays else float("nan"),
    )


def line(row: Row) -> str:
    """The row in words."""
    situation = row.situation
    share = {0.0: "independent", 0.5: "half common", 1.0: "all common"}[situation.common_share]
    noise = f"{share}, {'bounded' if situation.bounded else 'Gaussian'}"
    event = "none"
    if situation.event == "edge":
        event = f"edge jumps {degrees(situation.size):g} deg"
    elif situation.event:
        event = f"{1e3 * situation.size:g} mm {situation.event}"
    return HEADER.format(
        f"{degrees(situation.deviation):.2f} deg",
        noise,
        situation.travel,
        event,
        f"{100 * row.too_early:.1f} %" if situation.event else "-",
        f"{100 * row.ended:.1f} %",
        f"{100 * row.first_refused:.1f} %" if situation.event else "-",
        f"{row.delay:.0f}" if situation.event else "-",
    )


if __name__ == "__main__":
    sys.exit(main())
