"""The command `replay`: a bag played to the nodes, as by replay.launch.py, without the package launch."""

import signal
import sys
from collections.abc import Sequence

from knee_gap_bringup.launching.plan import replay_plan, replay_problem
from knee_gap_bringup.launching.supervisor import supervise
from knee_gap_core.node.command_line import Parser


def tell(line: str) -> None:
    """Print a line at once."""
    print(f"replay: {line}", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Play the bag; return 0, or the code of the process that failed."""
    parser = Parser(prog="replay", description=__doc__)
    parser.add_argument("bag", metavar="BAG", help="bag folder or .mcap file")
    parser.add_argument(
        "--out", default="", metavar="OUT", help="bag to record the results to; must not exist"
    )
    parser.add_argument("--rate", default="1.0", metavar="R", help="times as fast as recorded (1)")
    parser.add_argument(
        "--params",
        default="",
        metavar="FILE",
        help="parameter file of the nodes (calibration.yaml of the bag, else its scope.yaml)",
    )
    parser.add_argument("--namespace", default="knee_gap", help="namespace of the nodes (knee_gap)")
    given = parser.parse_args(argv)
    if problem := replay_problem(given.bag, given.out, rate=given.rate, params=given.params):
        print(f"replay: {problem}", file=sys.stderr)
        return 1
    plan = replay_plan(given.bag, given.out, rate=given.rate, params=given.params, namespace=given.namespace)
    return supervise(plan, tell=tell, stopped_code=128 + signal.SIGINT)


if __name__ == "__main__":
    sys.exit(main())
