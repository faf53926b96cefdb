"""The command `train_segmentation`: trains the network of the segmentation 'learned'.

First on rendered pictures alone, then on these and on marked pictures of all sources (learned.onnx), and once
more without each source or group of sources (without_SOURCE+SOURCE.onnx), to score a source by a network that
has not seen it.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from knee_gap_core.node.arguments import Parser
from knee_gap_core.values.errors import KneeGapError
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.training.card import data_card
from knee_gap_perception.training.examples import (
    RENDERED,
    Example,
    read_marked,
    read_renders,
    sources_of,
)
from knee_gap_perception.training.fitting import fit, layer_statistics
from knee_gap_perception.training.mixture import Mixture
from knee_gap_perception.training.model import Parameters, drawn, jax_modules
from knee_gap_perception.training.onnx_file import write_network

RATE = 3e-3  # of learning, at most
FINE_RATE = 1.5e-3
STATISTICS_BATCHES = 24
EVERYTHING = "learned"


@dataclass(frozen=True)
class Plan:
    """How long and from which seed: `first` steps on renders, `second` on the mixture."""

    seed: int
    first: int
    second: int


def main(argv: Sequence[str] | None = None) -> int:
    """Train; return 0 if all networks are written."""
    asked = _parser().parse_args(argv)
    plan = Plan(asked.seed, asked.steps[0], asked.steps[1])
    cv2.setNumThreads(1)
    try:
        if plan.seed < 0 or min(plan.first, plan.second) < 1:
            raise PerceptionError("the seed must not be negative, and each stage has at least one step")
        jax_modules()
        renders = read_renders(asked.renders)
        pictures = read_marked(asked.marks, asked.pictures)
        asked.out.mkdir(parents=True, exist_ok=True)
        (asked.out / "data_card.md").write_text(data_card(renders, pictures, plan), encoding="utf-8")
        begun = _first_stage(renders, plan, asked.out, again=not asked.resume)
        for name in _wanted(pictures, asked.without, asked.only):
            used = [example for example in pictures if example.source not in name.split("+")]
            _second_stage(begun, [*renders, *used], plan, asked.out / f"{_file_name(name)}.onnx")
    except (KneeGapError, OSError) as error:
        print(f"train_segmentation: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("train_segmentation: stopped before the end", file=sys.stderr)
        return 130
    return 0


def _parser() -> Parser:
    parser = Parser(prog="train_segmentation", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the networks")
    parser.add_argument(
        "--renders", type=Path, required=True, metavar="FOLDER", help="as render_examples writes it"
    )
    parser.add_argument(
        "--pictures",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="folder that contains the picture folders",
    )
    parser.add_argument("--marks", type=Path, nargs="+", required=True, metavar="FILE", help="files of marks")
    parser.add_argument("--seed", type=int, default=14, help="of parameters and batches (14)")
    parser.add_argument(
        "--steps",
        type=int,
        nargs=2,
        default=(1500, 700),
        metavar=("FIRST", "SECOND"),
        help="training steps on renders, then on renders and pictures (1500 700)",
    )
    parser.add_argument(
        "--without", nargs="*", metavar="SOURCE", help="sources, or groups A+B, to leave out in turn (each)"
    )
    parser.add_argument("--only", action="store_true", help="train only the networks that leave out a source")
    parser.add_argument("--resume", action="store_true", help="take the first stage from the folder")
    return parser


def _wanted(pictures: Sequence[Example], without: Sequence[str] | None, only: bool) -> list[str]:
    """Sources to leave out, the empty name for none."""
    known = sources_of(pictures)
    chosen = known if without is None else list(without)
    if unknown := sorted({name for group in chosen for name in group.split("+")} - set(known)):
        raise PerceptionError(f"no picture is of the source '{unknown[0]}'; sources are {', '.join(known)}")
    return chosen if only else ["", *chosen]


def _file_name(without: str) -> str:
    return f"without_{without}" if without else EVERYTHING


def _first_stage(renders: Sequence[Example], plan: Plan, out: Path, *, again: bool) -> Parameters:
    """Parameters after the renders; they are kept in the folder."""
    path = out / "first_stage.npz"
    if not again and path.is_file():
        with np.load(path) as kept:
            return {name: kept[name] for name in kept.files}
    batches = Mixture(renders, plan.seed).batches()
    begun = fit(drawn(plan.seed), batches, plan.first, RATE, _report(RENDERED))
    np.savez(path, **begun)
    return begun


def _second_stage(begun: Parameters, examples: Sequence[Example], plan: Plan, path: Path) -> None:
    batches = Mixture(examples, plan.seed + 1).batches()
    fitted = fit(begun, batches, plan.second, FINE_RATE, _report(path.stem))
    write_network({**fitted, **layer_statistics(fitted, batches, STATISTICS_BATCHES)}, path)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB", flush=True)


def _report(name: str) -> Callable[[int, float, float], None]:
    def report(step: int, loss: float, seconds: float) -> None:
        print(f"{name}: step {step}, loss {loss:.3f}, {seconds / 60.0:.1f} min of CPU", flush=True)

    return report
