"""The command `check`: contents of a bag, its damage, and whether knee_gap can process it."""

import argparse
import sys
from collections.abc import Sequence

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.node.command_line import Parser, run
from knee_gap_replay.bag_check import TopicCheck, check_topics, reasons_against
from knee_gap_replay.topics import add_topic_arguments, choices, topics_from
from knee_gap_replay.whole_bags.output import add_force_argument
from knee_gap_replay.whole_bags.recovery import recover


def _line(check: TopicCheck, width: int) -> str:
    rate = f"{check.rate:7.1f} Hz" if check.rate == check.rate else " " * 10
    words = "; ".join(check.remarks())
    return f"{check.name:{width}}  {len(check.record_ns):7d}  {rate}  {check.msgtype}  {words}".rstrip()


def _run(arguments: argparse.Namespace) -> int:
    with BagReader(arguments.bag, salvage=arguments.recover is not None) as reader:
        if reader.renamed:
            print(reader.renamed)
        checks = check_topics(reader)
        width = max((len(name) for name in checks), default=0)
        for check in checks.values():
            print(_line(check, width))
        losses = len(reader.losses)
        print(f"{losses} damaged or missing parts" if losses else "complete and undamaged")
        if arguments.recover is not None:
            saved = recover(reader, arguments.recover, replace=arguments.force)
            count = f"{saved.message_count} messages of {saved.topic_count} topics"
            print(f"{count} saved in {arguments.recover}")
            return 0
        reasons = reasons_against(checks, topics_from(arguments, reader.topics))
        reasons += [hint] if (hint := choices(reader.topics, topics_from(arguments, reader.topics))) else []
    print("not usable: " + "; ".join(reasons) if reasons else "usable")
    return 1 if reasons else 0


def _parser() -> Parser:
    parser = Parser(prog="check", description=__doc__)
    parser.add_argument("bag", metavar="BAG", help="bag folder or .mcap file")
    parser.add_argument(
        "--recover", metavar="OUT", help="save every complete message of a damaged bag in a new one"
    )
    add_force_argument(parser)
    add_topic_arguments(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Check a bag; return 0 if it can be used."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
