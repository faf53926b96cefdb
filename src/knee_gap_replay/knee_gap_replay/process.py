"""The command `process`: bags of results from bags of inputs, by the cores of the live nodes, without ROS.

Messages are processed in the order of their stamps, none is dropped, and the same bag gives the same bytes,
whatever the number of workers.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from knee_gap_core.node.command_line import Parser, run
from knee_gap_replay.topics import add_topic_arguments, namespace_from
from knee_gap_replay.whole_bags.output import add_force_argument


def _run(arguments: argparse.Namespace) -> int:
    # Only here, so that --help and a mistake of the command line are answered at once.
    from knee_gap_replay.whole_bags.cluster_pool import ClusterPool
    from knee_gap_replay.whole_bags.many_bags import process_many
    from knee_gap_replay.whole_bags.one_bag import Job, process_one
    from knee_gap_replay.whole_bags.pools import Pool, ProcessPool

    def job(bag: str, out: str, *, replace: bool) -> Job:
        return Job(
            bag=bag,
            out=out,
            replace=replace,
            params_file=arguments.params_file,
            namespace=namespace_from(arguments),
            topics=(arguments.image, arguments.camera_info, arguments.pose),
            with_mask=arguments.gap_mask,
        )

    *bags, out = arguments.bags
    if len(bags) > 1 or arguments.into or arguments.scheduler:
        address = arguments.scheduler
        pool: Pool = ClusterPool(address) if address else ProcessPool(arguments.workers)
        return process_many(bags, Path(out), job, pool, force=arguments.force)
    result = process_one(job(bags[0], out, replace=arguments.force), arguments.workers)
    for line in result.lines:
        print(f"process: {line}", flush=True)
    return result.exit_code


def _workers(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 256:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 256, not '{text}'")
    return int(text)


class _BagsAndOut(argparse.Action):
    """At least one bag, and what is to be written."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, _: Any = None) -> None:
        if len(values) < 2:
            parser.error("the following arguments are required: OUT")
        setattr(namespace, self.dest, values)


def _parser() -> Parser:
    parser = Parser(
        prog="process",
        description=__doc__,
        usage="process [options] BAG OUT\n       process [options] BAG BAG... FOLDER",
    )
    parser.add_argument(
        "bags",
        nargs="+",
        action=_BagsAndOut,
        metavar="BAG",
        help="bag folders or .mcap files, and last the bag to write; of several bags the folder for their "
        "results, one bag each, and for summary.csv. Run again, it goes on where it was stopped",
    )
    add_force_argument(parser)
    parser.add_argument(
        "--into", action="store_true", help="take the last argument as a folder of results for one bag too"
    )
    parser.add_argument(
        "--workers",
        type=_workers,
        metavar="N",
        help="processes at once (as many as there are cores): bags, or the two stages of one bag",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="process on a cluster, by Dask (tcp://HOST:8786), whose workers see bags and results under the "
        "same paths; the last argument is a folder. Needs tools/requirements/cluster.lock",
    )
    parser.add_argument(
        "--params-file",
        metavar="YAML",
        help="ROS parameters of the nodes; default: calibration.yaml in the bag as calibration_file, or else "
        "its scope.yaml",
    )
    parser.add_argument(
        "--gap-mask", action="store_true", help="write the gap mask of every image as well (gap_mask)"
    )
    add_topic_arguments(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Process one bag or many."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
