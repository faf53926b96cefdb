"""The command `report`: a page for each bag and one over all, to be opened in a browser without a network.

It needs the results that `process`, `record` or the demo wrote. Beside the pages are all numbers as CSV. Of
simulated bags the truth is shown too; it and the images are taken from the bag of inputs, if that is another.
"""

import argparse
import csv
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.command_line import Parser, run
from knee_gap_core.user_files import shown
from knee_gap_core.values.errors import KneeGapError
from knee_gap_replay.report.comparison import Truths
from knee_gap_replay.report.frames import choose_stamps, draw_frames
from knee_gap_replay.report.page import INDEX_COLUMNS, Content, bag_page, index_page, index_row
from knee_gap_replay.report.results import Floats, Results, read_results
from knee_gap_replay.report.table import require_parquet, write_csv, write_parquet
from knee_gap_replay.topics import add_topic_arguments, namespace_from, topics_from

INDEX = "index.html"
TABLE = "bags.csv"
_PARTLY = 1  # exit code if a bag could not be reported


def report(path: Path, name: str, recording: Path, arguments: argparse.Namespace) -> Content:
    """What the page of one bag shows. Raises BagError for bags that cannot be read or lack results."""
    space = namespace_from(arguments)
    results = read_results(path, space)
    edges_topic = f"{space}/gap_edges"
    truth, truth_note = _truth(results, recording, edges_topic, arguments.truth)
    with BagReader(recording) as bag:
        image_topic = topics_from(arguments, bag.topics).image
        has_images = image_topic in bag.topics
    stamps = choose_stamps(results, arguments.frames)
    frames = draw_frames(recording, image_topic, path, edges_topic, set(stamps))
    frames_note = "The bag of inputs has no image of these estimates."
    if not has_images:
        frames_note = f"{shown(recording)} has no images; name the bag of inputs with --input."
    return Content(name, results, truth, truth_note, frames, frames_note)


def _truth(results: Results, recording: Path, edges_topic: str, most: int) -> tuple[Floats, str]:
    """Truth of each estimate [m], NaN if not computed, and why there is none at all."""
    truth = np.full(len(results.status), np.nan)
    try:
        truths = Truths(recording, results.path, edges_topic)
    except KneeGapError as error:
        return truth, f"not known: {error}"
    # Evenly over the estimates of images: an image costs a fraction of a second.
    of_images = np.flatnonzero(np.isfinite(results.time) & (results.track_ids > 0))
    if of_images.size and most:
        places = np.linspace(0, of_images.size - 1, min(most, of_images.size)).round().astype(int)
        for index in np.unique(of_images[places]):
            truth[index] = truths.instrument_gap(int(results.stamps_ns[index]))
    known = int(np.isfinite(truth).sum())
    return truth, f"computed of {known} estimates, none of them VALID" if most else "not computed"


def _names(paths: Sequence[Path]) -> list[str]:
    """A name for each bag that can be a file's and a link's, all different."""
    names: list[str] = []
    taken = {INDEX.removesuffix(".html"), TABLE.removesuffix(".csv")}
    for path in paths:
        plain = re.sub(r"[^\w.-]+", "_", path.resolve().name.removesuffix(".mcap")).strip(".") or "bag"
        name, count = plain, 1
        while name in taken:
            count += 1
            name = f"{plain}-{count}"
        taken.add(name)
        names.append(name)
    return names


def _run(arguments: argparse.Namespace) -> int:
    paths, out = [Path(bag) for bag in arguments.bags], Path(arguments.output)
    if arguments.parquet:
        require_parquet()
    inputs = [Path(bag) for bag in arguments.input or ()] or paths
    if len(inputs) not in (1, len(paths)):
        raise BagError(f"--input names {len(inputs)} bags for {len(paths)}: give one, or one for each")
    inputs = inputs * len(paths) if len(inputs) == 1 else inputs
    if out.exists() and not out.is_dir():
        raise BagError(f"{shown(out)} exists and is not a folder")
    if out.is_dir() and any(out.iterdir()) and not arguments.force:
        raise BagError(f"{shown(out)} exists already; choose another folder or replace it with --force")
    contents: list[Content] = []
    failed: list[tuple[str, str]] = []
    out.mkdir(parents=True, exist_ok=True)
    jobs = list(zip(paths, _names(paths), inputs, strict=True))
    for path, name, recording in tqdm(jobs, disable=not sys.stderr.isatty(), leave=False):
        try:
            content = report(path, name, recording, arguments)
        except BagError as error:
            print(f"report: {error}", file=sys.stderr)
            failed.append((shown(path), str(error)))
            continue
        (out / f"{name}.html").write_text(bag_page(content), encoding="utf-8")
        write_csv(content, out / f"{name}.csv")
        if arguments.parquet:
            write_parquet(content, out / f"{name}.parquet")
        # The pictures are written: many bags must not fill the memory with them.
        contents.append(content._replace(frames=()))
    _write_index(contents, failed, out)
    print(f"report: {len(contents)} of {len(paths)} bags in {out / INDEX}")
    return _PARTLY if failed else 0


def _write_index(contents: Sequence[Content], failed: Sequence[tuple[str, str]], out: Path) -> None:
    (out / INDEX).write_text(index_page(contents, failed), encoding="utf-8")
    with (out / TABLE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name.rstrip("#") for name in INDEX_COLUMNS])
        writer.writerows(index_row(content) for content in contents)


def _count(text: str) -> int:
    """A whole number of at least 0, for `type=` of an argument."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, is {text}")
    return value


def _parser() -> Parser:
    parser = Parser(prog="report", description=__doc__)
    parser.add_argument("bags", metavar="BAG", nargs="+", help="bag of results: a folder or an .mcap file")
    parser.add_argument("--output", required=True, metavar="FOLDER", help="folder of the pages")
    parser.add_argument(
        "--input",
        nargs="+",
        metavar="BAG",
        help="bag of inputs, for images and truth: one for all, or one for each BAG (the BAG itself)",
    )
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    parser.add_argument(
        "--parquet", action="store_true", help="write the numbers as Parquet as well; needs pyarrow"
    )
    parser.add_argument("--frames", type=_count, default=6, metavar="N", help="pictures a bag (6)")
    parser.add_argument(
        "--truth", type=_count, default=60, metavar="N", help="estimates whose truth is computed (60)"
    )
    add_topic_arguments(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Report bags; return 0 if all of them could be reported."""
    return run(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
