"""The command `process`: a bag of results from a bag of inputs, by the cores of the live nodes, without ROS.

Messages are processed in the order of their stamps, none is dropped, and the same bag gives the same bytes.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.node.command_line import Parser, run
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_replay.pipeline import GapPipeline
from knee_gap_replay.processing import process
from knee_gap_replay.topics import add_topic_arguments, namespace_from, topics_from
from knee_gap_replay.whole_bags.output import add_force_argument, refuse_input_as_output

# Files that a bag folder may contain: the calibration of its scope, or parameters for its scope.
_CALIBRATION, _BESIDE = "calibration.yaml", "scope.yaml"


def _parameters(arguments: argparse.Namespace) -> ParametersFile:
    """Parameters from the named file, else from the files in the bag folder."""
    if arguments.params_file is not None:
        return ParametersFile(Path(arguments.params_file))
    bag = Path(arguments.bag)
    folder = bag if bag.is_dir() else bag.parent
    if (folder / _CALIBRATION).is_file():
        return ParametersFile.with_calibration(folder / _CALIBRATION)
    return ParametersFile(folder / _BESIDE if (folder / _BESIDE).is_file() else None)


def _run(arguments: argparse.Namespace) -> int:
    with BagReader(arguments.bag) as reader:
        if reader.renamed:
            print(f"process: {reader.renamed}", flush=True)
        parameters = _parameters(arguments)
        topics = topics_from(arguments, reader.topics)
        pipeline = GapPipeline.from_parameters(
            parameters, topics, namespace_from(arguments), with_mask=arguments.gap_mask
        )
        reader.messages(pipeline.inputs)  # raises for a bag without them before anything is written
        refuse_input_as_output(arguments.bag, arguments.out)
        with BagWriter(arguments.out, metadata=reader.metadata, replace=arguments.force) as writer:
            counts = process(reader, writer, pipeline)
    for flaw in pipeline.flaws():
        print(f"process: {flaw}")
    summary = ", ".join(f"{count} {topic}" for topic, count in counts.items())
    print(f"process: {summary} in {arguments.out}")
    return 0


def _parser() -> Parser:
    parser = Parser(prog="process", description=__doc__)
    parser.add_argument("bag", metavar="IN", help="bag folder or .mcap file")
    parser.add_argument("out", metavar="OUT", help="the bag to write")
    add_force_argument(parser)
    parser.add_argument(
        "--params-file",
        metavar="YAML",
        help=f"ROS parameters of the nodes; default: {_CALIBRATION} in the bag as calibration_file, or else "
        f"its {_BESIDE}",
    )
    parser.add_argument(
        "--gap-mask", action="store_true", help="write the gap mask of every image as well (gap_mask)"
    )
    add_topic_arguments(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Process a bag."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
