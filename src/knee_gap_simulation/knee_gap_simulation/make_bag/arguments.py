"""The arguments of the command `make_bag`."""

import argparse
from pathlib import Path

from knee_gap_core.node.arguments import Parser, finite
from knee_gap_simulation.anatomy.meshes import UNITS
from knee_gap_simulation.anatomy.posing import Compartment
from knee_gap_simulation.calibration.bag import BOARDS, LENSES
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import Difficulty
from knee_gap_simulation.looks.look import Appearance
from knee_gap_simulation.scope.hand_motion import TravelDirection
from knee_gap_simulation.scope.media import INDICES, Medium, index_of


def difficulty_argument(text: str) -> tuple[str, int]:
    """A difficulty and its level from NAME=LEVEL. Raises argparse.ArgumentTypeError."""
    name, _, level = text.partition("=")
    if not level.isdigit():
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=LEVEL, such as debris=3")
    try:
        Difficulty.at(0, {name: int(level)})
    except SimulationError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return name, int(level)


def bag_parser() -> Parser:
    """The parser of make_bag's arguments."""
    parser = Parser(
        prog="make_bag",
        description="Make a bag of a scene of known gap, seen by a tracked arthroscope: two rims, or with "
        "--level a knee.",
    )
    parser.add_argument("out", type=Path, help="folder of the new bag")
    parser.add_argument(
        "--gap-mm",
        type=finite,
        help="distance between the rims (4); for a knee the smallest distance (drawn from 3-8)",
    )
    parser.add_argument(
        "--depth-mm", type=finite, help="distance from the lens to the gap (10; for a knee drawn from 8-15)"
    )
    parser.add_argument("--travel-mm", type=finite, default=8.0, help="travel of the scope")
    parser.add_argument("--seed", type=int, default=7, help="the same seed gives the same bag")
    parser.add_argument("--duration-s", type=finite, help="length of the recording (6; for a knee 4)")
    parser.add_argument("--fps", type=finite, help="images per second (60; with --calibration 30)")
    parser.add_argument("--quality", type=int, help="JPEG quality of the images of the rims, 1-100 (60)")
    parser.add_argument("--level", type=int, choices=range(4), help="a knee of this difficulty")
    parser.add_argument(
        "--difficulty",
        type=difficulty_argument,
        action="append",
        default=[],
        metavar="NAME=LEVEL",
        help=f"single difficulties of a knee: {', '.join(Difficulty.__dataclass_fields__)}",
    )
    parser.add_argument(
        "--travel-direction", choices=[str(d) for d in TravelDirection], help="in a knee (along the gap)"
    )
    parser.add_argument(
        "--appearance",
        choices=list(Appearance),
        help="look of a knee: plain, or real, drawn from the seed as arthroscopes show it (plain)",
    )
    parser.add_argument(
        "--anatomy",
        type=Path,
        metavar="FOLDER",
        help="a knee of meshes: STL, PLY or OBJ named femur, tibia, medial-meniscus, lateral-meniscus",
    )
    parser.add_argument("--mesh-unit", choices=list(UNITS), help="unit of the meshes (m)")
    parser.add_argument(
        "--compartment", choices=list(Compartment), help="compartment of that knee to look into (medial)"
    )
    parser.add_argument("--flexion-deg", type=finite, help="flexion of that knee (25)")
    parser.add_argument("--no-gap", action="store_true", help="a closed knee, without a gap")
    parser.add_argument("--calibration", action="store_true", help="record a board and pivoting to calibrate")
    parser.add_argument(
        "--video-delay-ms", type=finite, help="delay of the images' stamps (0; with --calibration 12)"
    )
    parser.add_argument("--board", choices=BOARDS, help="calibration board (charuco)")
    parser.add_argument("--lens", choices=LENSES, help="lens to calibrate (equidistant)")
    parser.add_argument(
        "--turn-deg",
        type=finite,
        help="rotate that scope to and fro in its camera head, with a visible notch (no rotation, no notch)",
    )
    parser.add_argument(
        "--scope-of", type=int, metavar="SEED", help="use the scope of the calibration bag of this seed"
    )
    parser.add_argument(
        "--medium",
        type=medium_argument,
        help="medium in the joint (saline) or around the board (air): air, saline, water or an index",
    )
    parser.add_argument(
        "--calibrated-in",
        type=medium_argument,
        metavar="MEDIUM",
        help="medium in which the lens of camera_info was calibrated (the same; with --scope-of air)",
    )
    parser.add_argument(
        "--portal-mm",
        type=float,
        help="pivot the scope about a portal this far behind its tip (default: a rotation of 2.5 deg)",
    )
    return parser


def medium_argument(text: str) -> Medium:
    """A medium by name or index. Raises argparse.ArgumentTypeError."""
    try:
        index = index_of(text)
    except SimulationError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text if text in INDICES else index
