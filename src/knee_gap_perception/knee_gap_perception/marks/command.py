"""The command `mark`: marks pictures of a folder by hand in a browser, or checks the marks they have."""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from knee_gap_core.node.arguments import Parser
from knee_gap_core.values.errors import KneeGapError
from knee_gap_perception.marks.marking_server import MarkingServer
from knee_gap_perception.marks.marking_session import MarkingSession
from knee_gap_perception.marks.marks_file import read_marks
from knee_gap_perception.marks.picture_files import marked_images

MARKS_NAME = "marks.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Serve the page until it is stopped, or check; return 0 if all went well."""
    arguments = _parser().parse_args(argv)
    marks = arguments.marks or arguments.folder / MARKS_NAME
    try:
        if arguments.check:
            return _check(marks, arguments.folder)
        return _serve(MarkingSession(arguments.folder, marks, arguments.frames), arguments.port)
    except (KneeGapError, OSError) as error:
        print(f"mark: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _parser() -> Parser:
    parser = Parser(prog="mark", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of pictures and videos")
    parser.add_argument(
        "--marks", type=Path, metavar="FILE", help=f"file of marks; default: {MARKS_NAME} in the folder"
    )
    parser.add_argument(
        "--frames", type=_count, default=10, metavar="N", help="frames of each video, evenly spread (10)"
    )
    parser.add_argument("--port", type=_port, default=8013, help="port on this machine (8013); 0: any")
    parser.add_argument(
        "--check", action="store_true", help="serve nothing; check that the marks go with the pictures"
    )
    return parser


def _serve(session: MarkingSession, port: int) -> int:
    with MarkingServer(session, port) as server:
        print(f"mark: open {server.address} in a browser; Ctrl-C ends", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("mark: stopped; what was saved is kept", flush=True)
    return 0


def _check(marks: Path, folder: Path) -> int:
    counts = Counter(
        (picture.source, picture.kind, str(picture.decision))
        for picture, _ in marked_images(read_marks(marks), folder)
    )
    print(f"{'source':<24} {'kind':<12} {'decision':<9} pictures")
    for (source, kind, decision), count in sorted(counts.items()):
        print(f"{source:<24} {kind:<12} {decision:<9} {count:8d}")
    return 0


def _count(text: str) -> int:
    return _whole(text, 1, 10_000)


def _port(text: str) -> int:
    return _whole(text, 0, 65_535)


def _whole(text: str, least: int, most: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"must be a whole number from {least} to {most}, is {text}")
    return value


if __name__ == "__main__":
    sys.exit(main())
