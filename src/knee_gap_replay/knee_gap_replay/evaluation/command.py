"""The command `evaluate`: scores of predicted gap masks (the paper's II-E, Table 2 and figure 8)."""

import argparse
import csv
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from knee_gap_core.bag.bag_paths import missing_bag
from knee_gap_core.node.arguments import Parser
from knee_gap_core.values.arrays import Image
from knee_gap_core.values.errors import KneeGapError
from knee_gap_perception.calibrate.bag_input import CalibrationBag
from knee_gap_perception.calibration.calibration_file import load_calibration
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.camera.camera_info import camera_from_info
from knee_gap_perception.camera.models import EquiangularCamera
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.evaluation.difference_picture import difference_picture, panel
from knee_gap_perception.evaluation.image_error import EdgeError, Overlap, edge_error, overlap, rms
from knee_gap_perception.segmentation.choice import WITHOUT_NETWORK
from knee_gap_replay.evaluation.marked_pairs import is_marks, marked_pairs
from knee_gap_replay.evaluation.pairs import SHEET_ROWS, BagTopics, Pair, bag_pairs, folder_pairs, is_bag


class Row(NamedTuple):
    """Scores of one pair of masks."""

    image_set: str
    name: str
    overlap: Overlap
    error: EdgeError | None


def evaluate(pairs: Iterable[Pair], camera: Camera | None, out: Path) -> list[Row]:
    """Score every pair; write its difference picture, and a sheet of the first pair of each set, to a folder.

    Without a camera, the paper's equiangular camera of 90 by 90 degrees is used at each image's size.
    """
    rows: list[Row] = []
    sheet: list[Image] = []
    for pair in pairs:
        height, width = pair.marked.shape
        lens = camera or EquiangularCamera(width, height)
        error = edge_error(pair.predicted, pair.marked, lens)
        rows.append(Row(pair.image_set, pair.name, overlap(pair.predicted, pair.marked), error))
        difference = difference_picture(pair.predicted, pair.marked, error)
        folder = out / "difference" / pair.image_set
        folder.mkdir(parents=True, exist_ok=True)
        _write_picture(folder / f"{pair.name}.png", difference)
        if sum(row.image_set == pair.image_set for row in rows) <= SHEET_ROWS:
            pictures = [] if pair.picture is None else [pair.picture]
            sheet.append(
                panel(f"{pair.image_set} {pair.name}", [*pictures, pair.marked, pair.predicted, difference])
            )
    if not rows:
        raise PerceptionError("no predicted mask has the stamp or name of a true one")
    _write_sheet(sheet, out / "sheet.png")
    return rows


def table(rows: Sequence[Row]) -> list[dict[str, float | str | int]]:
    """Rows of Table 2, one for each set and one for all: Dice, RMS errors at G0 and G1 and their average."""
    sets = list(dict.fromkeys(row.image_set for row in rows))
    groups = [(name, [row for row in rows if row.image_set == name]) for name in sets]
    if len(sets) > 1:
        groups.append(("all sets", list(rows)))
    return [{"set": name, **_summary(group)} for name, group in groups]


def _summary(rows: Sequence[Row]) -> dict[str, float | str | int]:
    errors = [row.error for row in rows if row.error is not None]
    nothing = np.full((2, 1), np.nan)
    pixels = rms(np.concatenate([nothing, *(error.squares_px for error in errors)], axis=1))
    degrees = np.degrees(rms(np.concatenate([nothing, *(error.squares for error in errors)], axis=1)))
    total = Overlap(*(sum(row.overlap[i] for row in rows) for i in range(4)))
    return {
        "images": len(rows),
        "dice_mean": float(np.mean([row.overlap.dice for row in rows])),
        "dice_pooled": total.dice,
        "g0_px": float(pixels[0]),
        "g1_px": float(pixels[1]),
        "average_px": float(pixels.mean()),
        "g0_deg": float(degrees[0]),
        "g1_deg": float(degrees[1]),
        "average_deg": float(degrees.mean()),
        "missed": float(np.mean([error.missed.mean() for error in errors])) if errors else float("nan"),
    }


def write_csv(rows: Sequence[Row], out: Path) -> None:
    """Write `images.csv`, one line per image, and `table.csv`, one line per set."""
    with (out / "images.csv").open("w", newline="", encoding="utf-8") as file:
        lines = [
            {"set": row.image_set, "name": row.name, **row.overlap._asdict(), **_summary([row])}
            for row in rows
        ]
        for line in lines:
            line.pop("images")
            line.pop("dice_pooled")
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
    with (out / "table.csv").open("w", newline="", encoding="utf-8") as file:
        summary = table(rows)
        writer = csv.DictWriter(file, list(summary[0]))
        writer.writeheader()
        writer.writerows(summary)


def _printed(rows: Sequence[Row]) -> None:
    names = ("images", "Dice", "G0 px", "G1 px", "G0 deg", "G1 deg", "average deg", "missed")
    print(f"{'set':<28}" + "".join(f"{name:>12}" for name in names))
    for line in table(rows):
        values = [
            f"{line['images']}",
            f"{line['dice_mean']:.4f}",
            f"{line['g0_px']:.2f}",
            f"{line['g1_px']:.2f}",
        ]
        values += [f"{line[key]:.3f}" for key in ("g0_deg", "g1_deg", "average_deg")]
        print(
            f"{line['set']!s:<28.28}"
            + "".join(f"{value:>12}" for value in [*values, f"{line['missed']:.1%}"])
        )


def _write_sheet(rows: Sequence[Image], path: Path) -> None:
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 4), (0, width - row.shape[1]), (0, 0))) for row in rows]
    _write_picture(path, np.vstack(padded))


def _write_picture(path: Path, image: Image) -> None:
    """Write a picture as PNG. Raises OSError if it cannot be written."""
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def _parser() -> Parser:
    parser = Parser(prog="evaluate", description=__doc__)
    parser.add_argument(
        "predicted",
        type=Path,
        help="folder of predicted masks, or a bag; with marks and without --pictures: folder of the pictures",
    )
    parser.add_argument(
        "marked",
        type=Path,
        nargs="?",
        help="folder of hand-marked masks of the same names, a file of marks (.json), or a bag with truth",
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="the images, for the sheet and for marks"
    )
    parser.add_argument("--out", type=Path, default=Path("out/evaluate"), metavar="FOLDER")
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="camera; default: camera_info of the bag, or the paper's 90 x 90 degrees for folders",
    )
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use every N-th image of a bag (1)")
    parser.add_argument("--camera-info-topic", default="/knee_gap/camera_info", metavar="TOPIC")
    parser.add_argument("--image-topic", default="/knee_gap/image_raw/compressed", metavar="TOPIC")
    parser.add_argument("--mask-topic", default="/knee_gap/gap_mask", metavar="TOPIC", help="predicted masks")
    parser.add_argument(
        "--truth-topic", default="/knee_gap/gap_mask_true", metavar="TOPIC", help="true masks"
    )
    parser.add_argument(
        "--segmentation",
        choices=WITHOUT_NETWORK,
        help="segment the images so; without it, if there are no masks, as segmentation_node does",
    )
    return parser


def _pairs(arguments: argparse.Namespace) -> tuple[int, Iterator[Pair]]:
    """Pairs of masks that the arguments name. Raises PerceptionError."""
    if arguments.every < 1:
        raise PerceptionError(f"--every must be at least 1, not {arguments.every}")
    if is_marks(arguments.marked):
        return marked_pairs(arguments.predicted, arguments.marked, arguments.pictures, arguments.segmentation)
    if not is_bag(arguments.predicted):
        if arguments.marked is None:
            if not arguments.predicted.is_dir():
                flaw = missing_bag(arguments.predicted) or f"{arguments.predicted} is not a bag or a folder"
                raise PerceptionError(flaw)
            raise PerceptionError(
                f"{arguments.predicted} is not a bag, it holds no MCAP file: "
                "for a folder of masks, give the folder of marked masks as well"
            )
        return folder_pairs(arguments.predicted, arguments.marked, arguments.pictures)
    truth = arguments.marked or arguments.predicted
    topics = BagTopics(arguments.image_topic, arguments.mask_topic, arguments.truth_topic)
    return bag_pairs(arguments.predicted, truth, topics, arguments.segmentation, arguments.every)


def _camera(arguments: argparse.Namespace) -> Camera | None:
    """Camera named by the arguments or contained in the bags. Raises PerceptionError if it is not valid."""
    if arguments.calibration is not None:
        return load_calibration(arguments.calibration).require_camera().camera()
    for path in (arguments.marked, arguments.predicted):
        if path is not None and not is_marks(path) and is_bag(path):
            info = CalibrationBag(path).camera_info(arguments.camera_info_topic)
            if info is not None:
                return camera_from_info(info)
    return None


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate; return 0 if all pairs were scored and written."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="evaluate: %(message)s", stream=sys.stderr)
    try:
        camera = _camera(arguments)
        count, pairs = _pairs(arguments)
        arguments.out.mkdir(parents=True, exist_ok=True)
        rows = evaluate(_progress(pairs, count), camera, arguments.out)
        write_csv(rows, arguments.out)
    except (KneeGapError, OSError) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("evaluate: stopped before the end", file=sys.stderr)
        return 130
    _printed(rows)
    print(f"{arguments.out}: table.csv, images.csv, sheet.png, difference/")
    return 0


def _progress(pairs: Iterable[Pair], count: int) -> Iterator[Pair]:
    """Show a progress bar on a terminal, else one line per tenth."""
    if sys.stderr.isatty():
        yield from tqdm(pairs, total=count, desc="evaluating", unit="image")
        return
    for index, pair in enumerate(pairs):
        if index % max(1, count // 10) == 0:
            print(f"evaluating: image {index} of {count}", file=sys.stderr, flush=True)
        yield pair


if __name__ == "__main__":
    sys.exit(main())
