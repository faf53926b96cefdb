"""Conversion of a Motive take (CSV export) to a bag of poses, aligned in time with a video or another bag.

Frames in which the body was not tracked are left out; tracking_node treats the gap in the bag as a drop-out.
Time zero of the take is its capture start (by the clock of Motive's machine, taken as UTC), or --start, or
the first message of the bag given with --align. --offset is added.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank
from knee_gap_core.node.command_line import Parser, finite, not_negative, run
from knee_gap_core.values.stamps import NANOSECONDS, set_stamp
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.trackers.motive_csv import Take, TakeBody, read_take
from knee_gap_perception.trackers.up_axis import UP_AXES
from knee_gap_replay.topics import namespace_from
from knee_gap_replay.whole_bags.output import add_force_argument

# ROS stamps count seconds in 31 bits.
_END_OF_STAMPS = 1 << 31
POSE = "geometry_msgs/msg/PoseStamped"


def write_take(
    take: Take, bodies: Sequence[tuple[str, TakeBody]], writer: BagWriter, start_ns: int
) -> list[int]:
    """Write bodies to their topics in the order of the frames; return the number of poses of each."""
    for topic, _ in bodies:
        writer.add_topic(topic, POSE, "sensor")
    seen = [body.seen for _, body in bodies]
    counts = [0] * len(bodies)
    for index, time in enumerate(take.time):
        stamp_ns = start_ns + round(float(time) * NANOSECONDS)
        for number, (topic, body) in enumerate(bodies):
            if seen[number][index]:
                writer.write(topic, _pose(body, index, stamp_ns), stamp_ns)
                counts[number] += 1
    return counts


def _pose(body: TakeBody, index: int, stamp_ns: int) -> Any:
    message = blank(POSE)
    set_stamp(message.header, stamp_ns)
    message.header.frame_id = "world"
    place, turn = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = (float(value) for value in body.position[index])
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in body.quaternion_xyzw[index])
    return message


def _start_ns(take: Take, arguments: argparse.Namespace) -> int:
    start: int
    if arguments.align is not None:
        start = _first_stamp_ns(arguments.align, arguments.align_topic)
    elif arguments.start is not None:
        start = round(arguments.start * NANOSECONDS)
    elif take.start is not None:
        start = round(take.start.timestamp() * 1000) * 1_000_000
    else:
        raise BagError(f"the take's start '{take.start_text}' cannot be read; set it with --start or --align")
    start += round(arguments.offset * NANOSECONDS)
    if start < 0:
        before = f"{-start / NANOSECONDS:.3f} s before 1970"
        raise BagError(f"the take would start {before}; check --start and --offset")
    if start + round(float(take.time[-1]) * NANOSECONDS) >= _END_OF_STAMPS * NANOSECONDS:
        raise BagError("the take would end after 2038, beyond ROS stamps; check --start and --offset")
    return start


def _first_stamp_ns(bag: str, topic: str | None) -> int:
    """Stamp of a bag's first message, or its recording time if it has none."""
    with BagReader(bag) as reader:
        first = next(iter(reader.messages(None if topic is None else [topic])), None)
        if first is None:
            raise BagError(f"{bag} has no message to align to")
        header = getattr(reader.deserialize(first), "header", None)
    if header is None:
        return int(first.time_ns)
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def _run(arguments: argparse.Namespace) -> int:
    try:
        take = read_take(Path(arguments.take), up_axis=arguments.up_axis, partial=arguments.partial)
        space = namespace_from(arguments)
        bodies = [(arguments.topic or f"{space}/scope_body/pose", take.body(arguments.body))]
        if arguments.reference is not None:
            bodies.append((f"{space}/reference_body/pose", take.body(arguments.reference)))
    except PerceptionError as error:
        raise BagError(str(error)) from None
    if not any(body.seen.any() for _, body in bodies[:1]):
        raise BagError(f"{arguments.take}: the body '{arguments.body}' is not tracked in any frame")
    start_ns = _start_ns(take, arguments)
    metadata = {"take": Path(arguments.take).name, "take_format": take.version, "take_start": take.start_text}
    with BagWriter(arguments.out, metadata=metadata, replace=arguments.force) as writer:
        counts = write_take(take, bodies, writer, start_ns)
    frames = len(take.time)
    if take.exported_count not in (None, frames):
        print(
            f"import_motive: {take.exported_count} frames by the header, {frames} in the file",
            file=sys.stderr,
        )
    summary = ", ".join(
        f"{count} of '{body.name}' on {topic}" for count, (topic, body) in zip(counts, bodies, strict=True)
    )
    print(f"import_motive: {frames} frames, poses: {summary}, in {arguments.out}")
    return 0


def _parser() -> Parser:
    parser = Parser(prog="import_motive", description=__doc__)
    parser.add_argument("take", metavar="TAKE.csv", help="CSV export of Motive, format 1.20 to 1.25")
    parser.add_argument("body", metavar="BODY", help="name or id of the scope's rigid body")
    parser.add_argument("out", metavar="OUT", help="the bag to write")
    add_force_argument(parser)
    parser.add_argument(
        "--reference", metavar="BODY", help="rigid body of the leg, written to NAMESPACE/reference_body/pose"
    )
    parser.add_argument("--namespace", default="/knee_gap", metavar="NAME", help="namespace (/knee_gap)")
    parser.add_argument("--topic", help="topic of the scope's poses (NAMESPACE/scope_body/pose)")
    parser.add_argument("--up-axis", choices=UP_AXES, default="y", help="axis that points up in the take (y)")
    parser.add_argument("--offset", type=finite, default=0.0, metavar="S", help="added to the stamps [s] (0)")
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        "--start", type=not_negative, metavar="S", help="time of the take's start since 1970 [s]"
    )
    start.add_argument("--align", metavar="BAG", help="bag whose first message is the take's start")
    parser.add_argument("--align-topic", metavar="TOPIC", help="use the first message on this topic")
    parser.add_argument("--partial", action="store_true", help="read a truncated file as far as it goes")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Import a take."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
