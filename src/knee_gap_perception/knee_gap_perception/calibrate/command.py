"""The command `calibrate`: calibration of a scope from recorded bags, step by step or all at once."""

import argparse
import logging
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_core.node.arguments import Parser, finite
from knee_gap_core.values.errors import KneeGapError
from knee_gap_perception.calibrate.measurements.boards import BOARD_SYNTAX, board_from_text
from knee_gap_perception.calibrate.procedure import Procedure
from knee_gap_perception.calibrate.recording import Recording, Request
from knee_gap_perception.calibration.calibration import Calibration
from knee_gap_perception.calibration.calibration_file import load_calibration, require_place, save_calibration
from knee_gap_perception.camera.medium import AIR, CHOICES, Medium, medium_of
from knee_gap_perception.camera.projection import NAMES, LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount

STEPS = {
    "intrinsics": "focal lengths, principal point and distortion, from a board",
    "time_offset": "time between video and tracker, from any textured scene",
    "hand_eye": "pose of the lens on the tracked body, from a stationary board",
    "oblique": "hand_eye, and the rotation axis of an oblique scope, from its notch or a second body",
    "pivot": "position of the scope's tip on the tracked body, from pivoting about it",
    "all": "all steps for which the bags have data",
}
# Parts of a recording; each may be a bag of its own.
PARTS = ("board", "oblique", "pivot")


def _parser() -> Parser:
    parser = Parser(prog="calibrate", description=__doc__)
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    defaults = Request({})
    for name, text in STEPS.items():
        step = steps.add_parser(name, help=text, description=text)
        step.add_argument(
            "bags",
            nargs="+",
            metavar="BAG",
            help=f"recorded bag, folder or .mcap; or one bag per step as STEP=BAG: {', '.join(PARTS)}",
        )
        step.add_argument(
            "--into", type=Path, required=True, metavar="FILE", help="calibration file to create or extend"
        )
        step.add_argument("--board", metavar="BOARD", help=BOARD_SYNTAX)
        step.add_argument("--image-topic", default=defaults.image_topic)
        step.add_argument("--pose-topic", default=defaults.pose_topic)
        step.add_argument(
            "--scope-pose-topic", help="second tracked body, on the scope, used instead of the notch"
        )
        step.add_argument("--model", choices=list(NAMES), default=defaults.model.distortion_model)
        step.add_argument("--high-order", action="store_true", help="fit the high distortion terms too")
        step.add_argument("--mount", choices=[str(m) for m in Mount], default=str(defaults.mount))
        step.add_argument("--views", type=int, default=defaults.views, help="images to search for the board")
        step.add_argument(
            "--medium",
            metavar="MEDIUM",
            help=f"medium around the board: {CHOICES} (as in FILE; new: air); best the medium of use",
        )
        step.add_argument("--fixed-intrinsics", action="store_true", help="keep the camera of FILE")
        step.add_argument("--time-offset", type=finite, metavar="S", help="initial value, instead of FILE's")
        step.add_argument("--max-offset", type=finite, default=defaults.max_offset, metavar="S")
        step.add_argument(
            "--begin", type=finite, default=0.0, metavar="S", help="part of the bag, from its start"
        )
        step.add_argument("--end", type=float, default=float("inf"), metavar="S")
    show = steps.add_parser("show", help="print a calibration and its hash")
    show.add_argument("file", type=Path)
    show.add_argument("--parameters", action="store_true", help="print it as parameters of tracking_node")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate; return 0 if it succeeded."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="calibrate: %(message)s", stream=sys.stderr)
    try:
        if arguments.step == "show":
            calibration = load_calibration(arguments.file)
            _show_parameters(calibration) if arguments.parameters else _show(calibration)
        else:
            _calibrate(arguments)
    except (KneeGapError, OSError) as error:
        print(f"calibrate {arguments.step}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"calibrate {arguments.step}: stopped before the end", file=sys.stderr)
        return 130
    return 0


def _calibrate(arguments: argparse.Namespace) -> None:
    request = Request(
        bags=_bags(arguments),
        board=board_from_text(arguments.board) if arguments.board else None,
        image_topic=arguments.image_topic,
        pose_topic=arguments.pose_topic,
        scope_pose_topic=arguments.scope_pose_topic,
        model=LensModel(arguments.model, arguments.high_order),
        mount=Mount(arguments.mount),
        views=arguments.views,
        free_intrinsics=not arguments.fixed_intrinsics,
        time_offset=arguments.time_offset,
        max_offset=arguments.max_offset,
        begin=arguments.begin,
        end=arguments.end,
    )
    given = medium_of(arguments.medium, "--medium") if arguments.medium is not None else None
    require_place(arguments.into)
    calibration = load_calibration(arguments.into) if arguments.into.exists() else None
    medium = _medium(given, calibration, arguments.into)
    recording = Recording(request, _progress)
    procedure = Procedure(recording, lambda line: print(f"  {line}", flush=True))
    for step in chosen_steps(arguments.step, recording):
        print(step, flush=True)
        calibration = getattr(procedure, step)(calibration)
    if calibration is not None:
        calibration = replace(calibration, medium=medium)
        save_calibration(calibration, arguments.into)
        print(f"{arguments.into}: hash {calibration.hash[:12]}")


def _medium(given: Medium | None, calibration: Calibration | None, path: Path) -> Medium:
    """Medium around the board, as given or as in the file. Raises PerceptionError if they differ."""
    if calibration is None or given is None:
        return given or (calibration.medium if calibration is not None else AIR)
    seen = calibration.camera is not None or calibration.lens is not None
    if seen and given != calibration.medium:
        raise PerceptionError(
            f"{path} was calibrated in {calibration.medium.value}, not in {given.value}: record all steps in "
            "one medium, or name a new file"
        )
    return given


def _bags(arguments: argparse.Namespace) -> dict[str, Path]:
    """Bags by the step that each is named for, "" for a bag with all steps. Raises PerceptionError."""
    named: dict[str, Path] = {}
    for text in arguments.bags:
        step, equals, path = text.partition("=")
        if not equals or step not in PARTS or os.path.lexists(text):
            step, path = "", text
        if step in named:
            wanted = ", ".join(f"{part}=BAG" for part in PARTS)
            twice = f"two bags are named for the step {step}" if step else "of several bags each is one step"
            raise PerceptionError(f"{twice}: name them {wanted}")
        named[step] = Path(path)
    if "" in named and len(named) > 1:
        raise PerceptionError(f"{named['']}: which step is it? Name each of several bags, as in board=BAG")
    if len(named) > 1 and (arguments.begin > 0.0 or arguments.end < float("inf")):
        raise PerceptionError("--begin and --end select a part of one bag, but several bags are given")
    return named


def chosen_steps(step: str, recording: Recording) -> list[str]:
    """Steps to run: one, or all that the bags have; for a bag without marks, those with a board."""
    if step != "all":
        return [step]
    marked = recording.steps
    lens = "oblique" if "oblique" in marked else "hand_eye"
    return ["time_offset", "intrinsics", lens, *(["pivot"] if "pivot" in marked else [])]


def _progress(items: Iterable[int], text: str) -> Iterable[int]:
    """Show a progress bar on a terminal, else one line per quarter."""
    known = list(items)
    if sys.stderr.isatty():
        yield from tqdm(known, desc=text, unit="image", leave=False)
        return
    marks = {len(known) * quarter // 4: 25 * quarter for quarter in range(4)}
    for index, item in enumerate(known):
        if index in marks:
            print(f"  {text}: {marks[index]} % of {len(known)} images", file=sys.stderr, flush=True)
        yield item


def _show_parameters(calibration: Calibration) -> None:
    print("/**/tracking_node:\n  ros__parameters:")
    for name, value in calibration.tracking_parameters().items():
        print(f"    {name}: {value}")


def _show(calibration: Calibration) -> None:
    print(f"hash {calibration.hash}")
    print(f"images {calibration.width_px}x{calibration.height_px} px")
    index = calibration.medium.index
    print(f"calibrated in {calibration.medium.value}, refractive index {index:g}")
    if (camera := calibration.camera) is not None:
        print(
            f"camera {camera.distortion_model}, f {camera.k[0]:.2f} {camera.k[4]:.2f} px, centre "
            f"{camera.k[2]:.2f} "
            f"{camera.k[5]:.2f} px, {camera.rms_px:.3f} px RMS"
        )
    if (lens := calibration.lens) is not None:
        position = " ".join(f"{1e3 * value:.3f}" for value in lens.T_body_lens[:3, 3])
        sigma = np.sqrt(np.trace(lens.covariance[3:, 3:])), np.sqrt(np.trace(lens.covariance[:3, :3]))
        print(
            f"lens at {position} mm on the {lens.mount}'s body, ± {1e3 * sigma[0]:.3f} mm, ± "
            f"{np.degrees(sigma[1]):.3f} deg"
        )
    if (oblique := calibration.oblique) is not None:
        turning = "may be rotated" if oblique.axis is not None else "must not be rotated"
        print(f"notch at {np.degrees(oblique.notch_angle):.2f} deg; the scope {turning} in its camera head")
    if (tip := calibration.tip) is not None:
        print("tip at " + " ".join(f"{1e3 * value:.3f}" for value in tip.position) + " mm on the body")
    if (clock := calibration.clock) is not None:
        print(f"time offset {1e3 * clock.offset:+.3f} ± {1e3 * clock.sigma:.3f} ms ({clock.source})")


if __name__ == "__main__":
    sys.exit(main())
