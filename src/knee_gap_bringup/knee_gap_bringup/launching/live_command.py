"""The command `live`: the three nodes on live topics, as by live.launch.py, without the package launch."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from knee_gap_bringup.launching.plan import RESPAWN_DELAY, live_plan, live_problem
from knee_gap_bringup.launching.supervisor import supervise
from knee_gap_core.node.command_line import Parser


def tell(line: str) -> None:
    """Print a line at once."""
    print(f"live: {line}", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the nodes until a signal or a final failure of a node; return its exit code, or 0."""
    params = Path(get_package_share_directory("knee_gap_bringup")) / "config" / "knee_gap.yaml"
    parser = Parser(prog="live", description=__doc__)
    parser.add_argument("--params", default=str(params), metavar="FILE", help="parameter file of the nodes")
    parser.add_argument("--namespace", default="knee_gap", help="namespace of the nodes (knee_gap)")
    parser.add_argument(
        "--respawn",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="restart a node that ended (yes)",
    )
    parser.add_argument(
        "--respawn-delay", default=str(RESPAWN_DELAY), metavar="S", help="pause before a restart (1)"
    )
    parser.add_argument(
        "--one-process", action="store_true", help="the three nodes in one process, suite_node"
    )
    arguments = parser.parse_args(argv)
    if problem := live_problem(arguments.params, arguments.respawn_delay):
        print(f"live: {problem}", file=sys.stderr)
        return 1
    plan = live_plan(
        arguments.params,
        arguments.namespace,
        respawn=arguments.respawn,
        one_process=arguments.one_process,
    )
    return supervise(plan, tell=tell, respawn_delay=float(arguments.respawn_delay))


if __name__ == "__main__":
    sys.exit(main())
