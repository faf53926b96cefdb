"""Real pictures that were marked by hand, against what the perception finds in them, by source and by kind.

Each picture is looked at by itself. The marks are in test/data/marks, one file for each folder of pictures of
its name; the pictures belong to others and are looked for beside the project. Without them nothing is done.
Written are pictures.csv (a line a picture), table.md and sheet.jpg (what is marked and what is found).
"""

import argparse
import csv
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.evaluation.picture_score import PictureScore, mean, score_picture
from knee_gap_perception.gap_detection.edge_parameters import EdgeParameters
from knee_gap_perception.image.field_of_view import find_field_of_view
from knee_gap_perception.marks.marked_picture import Decision, MarkedPicture, Region
from knee_gap_perception.marks.marks_file import read_marks
from knee_gap_perception.marks.picture_files import marked_images
from knee_gap_perception.segmentation.choice import WITHOUT_NETWORK

ROOT = Path(__file__).resolve().parents[1]
MARKS = ROOT / "test" / "data" / "marks"
PICTURES = ROOT.parent / "shared" / "data" / "images"
COLUMNS, TILE = 5, (400, 300)
COLOURS = {
    Region.GAP: (60, 255, 60),
    Region.INSTRUMENT: (60, 60, 255),
    Region.GLARE: (255, 80, 255),
    Region.DRAWN: (255, 200, 60),
    Region.UNCLEAR: (0, 180, 255),
}
BINS = (0.0, 0.1, 0.5, 0.9, 1.0)
HEAD = (
    "pictures",
    "openings found",
    "false gaps",
    "Dice",
    "points on instruments",
    "field right",
    "rim error",
    "notch seen",
    "false notches",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Score every marked picture; print the table and write it with a sheet."""
    parser = argparse.ArgumentParser(prog="bench_real_pictures", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=PICTURES, help="folder of picture folders")
    parser.add_argument("--marks", type=Path, nargs="+", default=sorted(MARKS.glob("*.json")), metavar="FILE")
    parser.add_argument("--segmentation", choices=WITHOUT_NETWORK, help="instead of the default")
    parser.add_argument(
        "--without",
        type=Path,
        metavar="FOLDER",
        help="score each source with the network of train_segmentation that was trained without it",
    )
    parser.add_argument("--out", type=Path, default=Path("out/real_pictures"), metavar="FOLDER")
    asked = parser.parse_args(argv)
    cv2.setNumThreads(1)
    parameters = EdgeParameters()
    if asked.segmentation:
        parameters = replace(parameters, segmentation=asked.segmentation)
    scores: list[PictureScore] = []
    tiles: list[Image] = []
    sections: list[PictureScore] = []
    try:
        for picture, image in marked(asked.marks, asked.folder):
            if asked.without is not None:
                weights = network_without(asked.without, picture.source)
                parameters = replace(parameters, segmentation="learned", network_path=str(weights))
            score, points = score_picture(picture, image, parameters)
            scores.append(score)
            sections.append(score_picture(picture, image, replace(parameters, minimum_confidence=0.0))[0])
            tiles.append(tile(picture, image, score, points))
    except PerceptionError as error:
        print(f"bench_real_pictures: {error}", file=sys.stderr)
        return 1
    if not scores:
        print(f"bench_real_pictures: no marked pictures in {asked.folder}: nothing is scored")
        return 0
    asked.out.mkdir(parents=True, exist_ok=True)
    text = table(scores) + "\n" + reliability(sections)
    (asked.out / "table.md").write_text(text, encoding="utf-8")
    write_csv(scores, asked.out / "pictures.csv")
    cv2.imwrite(str(asked.out / "sheet.jpg"), sheet(tiles))
    print(text)
    print(f"{asked.out}: table.md, pictures.csv, sheet.jpg")
    return 0


def network_without(folder: Path, source: str) -> Path:
    """The network of a folder that was trained without a source. Raises PerceptionError if there is none."""
    for path in sorted(folder.glob("without_*.onnx")):
        if source in path.stem.removeprefix("without_").split("+"):
            return path
    raise PerceptionError(f"{folder} holds no network that was trained without the source '{source}'")


def marked(files: Sequence[Path], folder: Path) -> Iterator[tuple[MarkedPicture, Image]]:
    """Marked pictures of each file, from the folder of its name; names absent folders."""
    for file in files:
        place = folder / file.stem
        if not place.is_dir():
            print(f"bench_real_pictures: no {place}, its pictures are skipped")
            continue
        yield from marked_images(read_marks(file), place)


def table(scores: Sequence[PictureScore]) -> str:
    """Rows by source, by kind, and of all, in Markdown."""
    groups: list[tuple[str, list[PictureScore]]] = []
    for name in ("source", "kind"):
        values = dict.fromkeys(getattr(score, name) for score in scores)
        groups += [
            (f"{name} {value}", [score for score in scores if getattr(score, name) == value])
            for value in values
        ]
    groups.append(("all", list(scores)))
    lines = ["| | " + " | ".join(HEAD) + " |", "|---" * (len(HEAD) + 1) + "|"]
    lines += [f"| {name} | " + " | ".join(cells(group)) + " |" for name, group in groups]
    return "\n".join(lines) + "\n"


def reliability(sections: Sequence[PictureScore]) -> str:
    """By source: of the best sections of its pictures, by their confidence, how many are marked gaps."""
    names = [f"{low:g} to {high:g}" for low, high in pairwise(BINS)]
    lines = ["| gaps among sections of confidence | " + " | ".join(names) + " |", "|---" * len(BINS) + "|"]
    known = [score for score in sections if score.found or score.false]
    for source in (*dict.fromkeys(score.source for score in known), "all"):
        group = [score for score in known if source in (score.source, "all")]
        row = []
        for low, high in pairwise(BINS):
            inside = [s for s in group if low <= s.confidence < high or s.confidence == high == 1.0]
            row.append(share(sum(score.found for score in inside), len(inside)))
        lines.append(f"| {source} | " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def cells(scores: Sequence[PictureScore]) -> list[str]:
    """Cells of one row."""
    opened = [score for score in scores if score.decision is Decision.GAP]
    closed = [score for score in scores if score.decision is Decision.NO_GAP]
    fields = [score for score in scores if np.isfinite(score.field_overlap)]
    notches = [score for score in scores if score.notch_marked]
    without = [score for score in scores if not score.notch_marked]
    rim = mean([score.rim_error for score in scores])
    dice = mean([score.dice for score in opened])
    return [
        str(len(scores)),
        share(sum(score.found for score in opened), len(opened)),
        share(sum(score.false for score in (*opened, *closed)), len(opened) + len(closed)),
        f"{dice:.2f}" if np.isfinite(dice) else "-",
        str(sum(score.on_instrument for score in scores)),
        share(sum(score.field_right for score in fields), len(fields)),
        f"{100 * rim:.1f} %" if np.isfinite(rim) else "-",
        share(sum(score.notch_seen for score in notches), len(notches)),
        share(sum(score.notch_false for score in without), len(without)),
    ]


def share(count: int, of: int) -> str:
    """A count of all, or a dash where there are none."""
    return f"{count} of {of}" if of else "-"


def write_csv(scores: Sequence[PictureScore], path: Path) -> None:
    """One line a picture."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(scores[0])))
        writer.writeheader()
        writer.writerows(asdict(score) for score in scores)


def tile(picture: MarkedPicture, image: Image, score: PictureScore, points: Array | None) -> Image:
    """The picture with its marks, the field that was found in yellow, the points, and the verdict."""
    width, height = TILE
    scale = min(width / image.shape[1], height / image.shape[0])
    drawn = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for region, colour in COLOURS.items():
        for polygon in picture.polygons(region):
            cv2.polylines(drawn, [np.rint(polygon * scale).astype(np.int32)], True, colour, 1, cv2.LINE_AA)
    field = find_field_of_view(image)
    if field is not None and np.isfinite(field.radius):
        centre = (round(field.centre[0] * scale), round(field.centre[1] * scale))
        cv2.circle(drawn, centre, round(field.radius * scale), (0, 255, 255), 1, cv2.LINE_AA)
    for point in points if points is not None else ():
        cv2.circle(drawn, (round(point[0] * scale), round(point[1] * scale)), 4, (255, 255, 255), -1)
    placed = np.zeros((height + 40, width, 3), np.uint8)
    placed[: drawn.shape[0], : drawn.shape[1]] = drawn[:height, :width]
    verdict = "found" if score.found else "FALSE" if score.false else "points" if points is not None else "-"
    field_words = "" if score.field_right else "  field wrong"
    words = (f"{picture.decision}: {verdict}{field_words}", picture.name)
    for row, line in enumerate(words):
        place = (4, height + 14 + 18 * row)
        cv2.putText(placed, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return placed


def sheet(tiles: Sequence[Image]) -> Image:
    """All tiles in rows."""
    blank = np.zeros_like(tiles[0])
    padded = [*tiles, *[blank] * (-len(tiles) % COLUMNS)]
    rows = [np.hstack(padded[start : start + COLUMNS]) for start in range(0, len(padded), COLUMNS)]
    return np.vstack(rows)


if __name__ == "__main__":
    sys.exit(main())
