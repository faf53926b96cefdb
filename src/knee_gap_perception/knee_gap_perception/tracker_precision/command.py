"""The command `tracker_precision`: DT and omega from bags or takes, as parameters to paste and a plot."""

import argparse
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from math import degrees, isnan
from pathlib import Path

import numpy as np

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.conversions.pose_messages import body_pose_from_message
from knee_gap_core.node.arguments import Parser, finite
from knee_gap_core.values.errors import KneeGapError
from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.calibrate.bag_input import opened
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_pose.pose_validity import PoseValidity, RefusalReason, ValidityParameters
from knee_gap_perception.tracker_precision.precision import (
    ErrorSums,
    PoseSeries,
    Precision,
    pooled,
    tracker_precision,
)
from knee_gap_perception.trackers.motive_csv import read_take

_LOG = logging.getLogger(__name__)
POSE_TYPES = ("geometry_msgs/msg/PoseStamped",)
# The first pose after a gap is good; only invalid poses are left out.
HARMLESS = {RefusalReason.GAP}


def series_of(name: str, bodies: Iterable[BodyPose]) -> PoseSeries:
    """Usable poses: tracked, finite, with increasing stamps.

    Raises PerceptionError if there are none.
    """
    validity = PoseValidity(ValidityParameters(jump_hold=0.0))
    sound = [body for body in bodies if (fault := validity.check(body)) is None or fault.reason in HARMLESS]
    if not sound:
        raise PerceptionError(f"{name}: no valid tracked pose")
    return PoseSeries(
        name=name,
        time=np.array([body.stamp_ns - sound[0].stamp_ns for body in sound]) / 1e9,
        position=np.array([body.position for body in sound]),
        quaternion_xyzw=np.array([body.quaternion_xyzw for body in sound]),
    )


def read_bodies(path: Path, topic: str | None, body: str | None, up_axis: str) -> list[BodyPose]:
    """Poses of a bag's topic or of a take's body. Raises PerceptionError if there are none."""
    if path.suffix.lower() == ".csv":
        take = read_take(path, up_axis=up_axis)
        if body is None and len(take.bodies) != 1:
            known = ", ".join(f"'{item.name}'" for item in take.bodies) or "none"
            raise PerceptionError(f"{path.name}: name a rigid body with --body; the take has: {known}")
        name = take.body(body).name if body is not None else take.bodies[0].name
        return [pose for frame in take.frames(1) for pose in frame.bodies if pose.name == name]
    with opened(path) as reader:
        poses = {name for name, msgtype in reader.topics.items() if msgtype in POSE_TYPES}
        chosen = topic or next((name for name in sorted(poses) if name.endswith("scope_body/pose")), None)
        if chosen not in poses:
            known = ", ".join(sorted(poses)) or "none"
            raise PerceptionError(
                f"{path}: no poses on {chosen or 'scope_body/pose'}; topics with poses: {known}"
            )
        return list(_readable_poses(reader, chosen))


def _readable_poses(reader: BagReader, topic: str) -> Iterator[BodyPose]:
    """Poses of a topic; a message that cannot be read is logged and skipped."""
    for entry in reader.messages([topic]):
        try:
            message = reader.deserialize(entry)
        except BagError as error:
            _LOG.warning(str(error))
            continue
        yield body_pose_from_message(message)


def table(precisions: Sequence[Precision]) -> list[str]:
    """Lines of a table: one for each recording, and one for all."""
    position, rotation = pooled(precisions)
    lines = [
        f"{'':28} {'position (mm)':>22} {'rotation (deg)':>22} {'poses':>16}",
        f"{'':28} {'rest':>10} {'motion':>11} {'rest':>10} {'motion':>11} {'rest':>7} {'motion':>8}",
    ]
    rows = [(item.series.name, item.position, item.rotation) for item in precisions]
    for name, moved, turned in [*rows, ("all", position, rotation)]:
        lines.append(
            f"{name[-28:]:28} {_shown(moved.rest.rms * 1e3, 4):>10} {_shown(moved.motion * 1e3, 4):>11} "
            f"{_shown(degrees(turned.rest.rms), 5):>10} {_shown(degrees(turned.motion), 5):>11} "
            f"{moved.rest.poses:>7} {moved.motion_smooth.poses:>8}"
        )
    return lines


def parameters_yaml(position: ErrorSums, rotation: ErrorSums, point: str) -> str:
    """Parameters of tracking_node, the larger of the errors at rest and in motion."""
    slow = "unknown: no segment at rest" if isnan(position.slow) else f"{position.slow * 1e3:.4f} mm"
    moved = [_shown(value * 1e3, 4) for value in (position.rest.rms, position.motion)]
    turned = [_shown(degrees(value), 5) for value in (rotation.rest.rms, rotation.motion)]
    return (
        "# RMS lengths of the error vectors, the larger of those at rest and in motion.\n"
        f"# position: rest {moved[0]} mm, motion {moved[1]} mm (slow part {slow})\n"
        f"# rotation: rest {turned[0]} deg, motion {turned[1]} deg\n"
        "tracking_node:\n"
        "  ros__parameters:\n"
        f"    translation_error: {position.worse:.3e}  # m\n"
        f"    rotation_error: {rotation.worse:.3e}  # rad\n"
        f"    translation_error_at: {point}\n"
    )


def _shown(value: float, digits: int) -> str:
    return "-" if isnan(value) else f"{value:.{digits}f}"


def _run(arguments: argparse.Namespace) -> None:
    # The plot's library takes a second to load; mistakes in the arguments are reported before.
    precisions = []
    for path in arguments.recordings:
        bodies = read_bodies(path, arguments.topic, arguments.body, arguments.up_axis)
        series = series_of(path.name, bodies)
        if arguments.lever is not None:
            series = series.at_point(arguments.lever)
        precisions.append(tracker_precision(series))
    position, rotation = pooled(precisions)
    print("\n".join(table(precisions)))
    if isnan(position.slow):
        print("tracker_precision: no segment at rest, so slowly changing errors are not included")
    elif position.slow > 2.0 * position.rest_smooth.rms:
        print(
            "tracker_precision: most of the error at rest is slow: was the body held in a hand? Put it down"
        )
    from knee_gap_perception.tracker_precision.plot import plot

    arguments.out.mkdir(parents=True, exist_ok=True)
    yaml = parameters_yaml(position, rotation, "body" if arguments.lever is None else "lens")
    (arguments.out / "tracker_precision.yaml").write_text(yaml)
    plot(precisions, arguments.out / "tracker_precision.png")
    print(yaml, end="")
    print(f"tracker_precision: {arguments.out / 'tracker_precision.yaml'} and .png written")


def _parser() -> Parser:
    parser = Parser(prog="tracker_precision", description=__doc__)
    add = parser.add_argument
    add("recordings", nargs="+", type=Path, metavar="BAG", help="bags, or takes exported by Motive (.csv)")
    add("--topic", help="topic of the poses (the one that ends in scope_body/pose)")
    add("--body", help="rigid body of a take")
    add("--up-axis", choices=("y", "z"), default="y", help="axis that points up in a take (y)")
    add(
        "--lever",
        nargs=3,
        type=finite,
        metavar=("X", "Y", "Z"),
        help="position of the lens in the body [m] (body_to_shaft_translation): report the errors there",
    )
    add("--out", type=Path, default=Path("out/tracker_precision"), help="folder for the YAML and the plot")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Report the precision; return 0, or 1 after one line about a mistake."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="tracker_precision: %(message)s", stream=sys.stderr)
    try:
        _run(arguments)
    except (KneeGapError, OSError) as error:
        print(f"tracker_precision: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("tracker_precision: stopped before the end", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
