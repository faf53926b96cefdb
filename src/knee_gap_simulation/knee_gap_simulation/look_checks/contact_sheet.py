"""The command `contact_sheet`: one picture of knees at levels 0 to 3, with real frames if given."""

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from knee_gap_core.node.arguments import Parser
from knee_gap_core.user_files import open_file
from knee_gap_core.values.errors import KneeGapError
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.difficulty import LEVELS
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.looks.look import Appearance
from knee_gap_simulation.scope.imaging import ByteImage

_SIZE_PX = 400
_LABEL_PX = 34
# Times in each level's recording [s]: the probe is visible at some and away at others.
_MOST_PICTURE_BYTES = 64 << 20
_MOST_FRAMES = 128
_MOMENTS_S = (1.0, 2.2, 3.0, 1.4)


def contact_sheet(
    seeds: Sequence[int], real: Sequence[ByteImage] = (), appearance: str = Appearance.PLAIN
) -> ByteImage:
    """Picture with one row of levels 0 to 3 for each seed, and rows of real frames (h, w, 3) below.

    Looks differ from seed to seed: with the appearance "real" each tile of a row has a seed of its own.
    """
    rows = [_label([f"level {level}" for level in LEVELS])]
    apart = 0 if appearance == Appearance.PLAIN else 1000
    for seed in tqdm(seeds, desc="rendering", unit="seed", disable=not sys.stderr.isatty()):
        rows.append(np.hstack([_tile(moment(level, seed + apart * level, appearance)) for level in LEVELS]))
        if not sys.stderr.isatty():
            print(f"rendered: seed {seed}", file=sys.stderr)
    if real:
        rows.append(_label(["real endoscopes"]))
    for first in range(0, len(real), len(LEVELS)):
        tiles = [_tile(image) for image in real[first : first + len(LEVELS)]]
        tiles += [np.zeros_like(tiles[0])] * (len(LEVELS) - len(tiles))
        rows.append(np.hstack(tiles))
    return np.vstack(rows)


def read_frames(path: Path, count: int = 4) -> list[ByteImage]:
    """Evenly spaced frames (h, w, 3) of a video or a folder of pictures, or one picture.

    Raises SimulationError if there is none.
    """
    pictures = sorted(p for p in path.iterdir() if p.suffix in (".jpg", ".png")) if path.is_dir() else [path]
    frames = [image for picture in pictures if (image := _picture(picture)) is not None]
    # A mask or an empty frame is black and white apart from compression artefacts.
    frames = [image for image in frames if ((image > 25) & (image < 230)).mean() > 0.1]
    if not frames and path.is_file():
        frames = _spread_frames(path)
    if not frames:
        raise SimulationError(f"{path} contains no picture and no video")
    chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int)
    return [np.asarray(frames[index], dtype=np.uint8) for index in chosen]


def _picture(path: Path) -> ByteImage | None:
    """The picture in a file, None if it cannot be decoded. Raises FileError if it is not a file."""
    with open_file(path) as file:
        data = np.frombuffer(file.read(_MOST_PICTURE_BYTES), dtype=np.uint8)
    return None if data.size == 0 else cv2.imdecode(data, cv2.IMREAD_COLOR)  # type: ignore[return-value]


def _spread_frames(path: Path) -> list[ByteImage]:
    """Evenly spaced frames of a video, as many as fit into memory."""
    frames: list[ByteImage] = []
    video, number, every = cv2.VideoCapture(str(path)), 0, 1
    while (read := video.read())[0]:
        if number % every == 0:
            frames.append(np.asarray(read[1], dtype=np.uint8))
        if len(frames) > _MOST_FRAMES:
            frames, every = frames[::2], 2 * every
        number += 1
    return frames


def moment(level: int, seed: int, appearance: str = Appearance.PLAIN) -> ByteImage:
    """An image of a knee, from the middle of its recording."""
    simulator = KneeSimulator(level, seed, appearance=appearance)
    index = round(_MOMENTS_S[level] * simulator.settings.fps)
    return next(simulator.frames(index, index + 1)).image


def _tile(image: ByteImage) -> ByteImage:
    """Central square of a picture."""
    height, width = image.shape[:2]
    left = max(0, (width - height) // 2)
    square = image[:, left : left + min(height, width)]
    return np.asarray(cv2.resize(square, (_SIZE_PX, _SIZE_PX), interpolation=cv2.INTER_AREA), np.uint8)


def _label(texts: Sequence[str]) -> ByteImage:
    strip = np.full((_LABEL_PX, _SIZE_PX * len(LEVELS), 3), 24, np.uint8)
    for index, text in enumerate(texts):
        place = (index * _SIZE_PX + 12, _LABEL_PX - 10)
        cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (225, 225, 225), 1, cv2.LINE_AA)
    return strip


def main(argv: Sequence[str] | None = None) -> int:
    """Write a contact sheet; return 0 if it is written."""
    parser = Parser(prog="contact_sheet", description=__doc__)
    parser.add_argument("out", type=Path, help="output picture, .png or .jpg")
    parser.add_argument("--seeds", type=int, nargs="+", default=[4, 2, 11], help="seeds, one knee per row")
    parser.add_argument(
        "--appearance", choices=list(Appearance), default=Appearance.PLAIN, help="of the knees (plain)"
    )
    parser.add_argument(
        "--beside", type=Path, nargs="*", default=[], help="real frames: pictures, folders of them, or videos"
    )
    arguments = parser.parse_args(argv)
    try:
        if arguments.out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise SimulationError(f"{arguments.out} must end in .png or .jpg")
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        real = [frame for path in arguments.beside for frame in read_frames(path)]
        sheet = contact_sheet(arguments.seeds, real, arguments.appearance)
    except (KneeGapError, OSError) as error:
        print(f"contact_sheet: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("contact_sheet: stopped before the end", file=sys.stderr)
        return 130
    if not cv2.imwrite(str(arguments.out), sheet):
        print(f"contact_sheet: {arguments.out} cannot be written as a picture", file=sys.stderr)
        return 1
    print(arguments.out)
    return 0
