"""Real endoscope frames: a sheet of what is found in them to look at, and the jitter of points held still.

Each file is looked at by itself, so that every frame shows a fresh choice of points, and folders also in
order, so that a track shows. Held still: each frame is repeated with sensor noise, brightness that breathes
and JPEG, as a live camera's; jitter is the RMS of the points about their mean, and drift their last place
against the first. Without the recordings nothing is done.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image
from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.camera.models import FisheyeCamera
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.edge_tracking.overlay import draw_overlay

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "images"
DEFAULT = (RECORDINGS / "sinus_endoscope", RECORDINGS / "laparoscope_video" / "endo.mp4")
COLUMNS, TILE_PX = 4, 480
NOISE = 2.0  # [grey levels] of a camera head
BREATHING = 0.04  # [-] of brightness, as of automatic exposure and light
FRAME_NS = 16_666_667


def main(argv: Sequence[str] | None = None) -> int:
    """Write the sheet, print what was found and the jitter."""
    parser = argparse.ArgumentParser(prog="bench_real", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("path", type=Path, nargs="*", default=list(DEFAULT), help="folders or videos")
    parser.add_argument("--out", type=Path, default=Path("out/real_frames.jpg"), help="sheet to write")
    parser.add_argument("--frames", type=int, default=12, help="at most so many of each")
    parser.add_argument("--still", type=int, default=60, help="images that each frame is held still for")
    asked = parser.parse_args(argv)
    paths = [path for path in asked.path if path.exists()]
    if not paths:
        print("bench_real: no real recordings here")
        return 0
    tiles = []
    for path in paths:
        frames = spread(list(pictures(path)), asked.frames)
        tiles += [looked_at(frame) for frame in frames]
        print_tracks(path.name, [held_still(frame, asked.still, seed) for seed, frame in enumerate(frames)])
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(asked.out), sheet(tiles))
    print(f"{asked.out}: {len(tiles)} frames")
    return 0


def pictures(path: Path) -> Iterator[Image]:
    """The frames of a video, or of a folder of numbered pictures."""
    if path.is_dir():
        for file in sorted(path.glob("[0-9]*.jpg")):
            yield np.asarray(cv2.imread(str(file)), np.uint8)
        return
    video = cv2.VideoCapture(str(path))
    while (read := video.read())[0]:
        yield np.asarray(read[1], np.uint8)


def spread(frames: list[Image], count: int) -> list[Image]:
    """At most so many frames, evenly spread."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]


def camera_for(image: Image) -> FisheyeCamera:
    """A camera of a usual scope: what is given in pixels does not depend on it."""
    height, width = image.shape[:2]
    return FisheyeCamera(width, height, 0.6 * height, 0.6 * height, width / 2, height / 2)


def looked_at(image: Image) -> Image:
    """The frame with all that is found in it."""
    detector, camera = GapEdgeTracker(), camera_for(image)
    edges = detector.process(0, image, camera)
    drawn = draw_overlay(image, edges, detector.gap_mask(), detector.reason, camera)
    scale = TILE_PX / drawn.shape[1]
    return np.asarray(
        cv2.resize(drawn, (TILE_PX, round(drawn.shape[0] * scale)), interpolation=cv2.INTER_AREA), np.uint8
    )


def held_still(image: Image, count: int, seed: int) -> npt.NDArray[np.float64] | None:
    """Pixels (n, 2, 2) of the points while a frame is repeated; None where no points are found."""
    detector, camera, rng = GapEdgeTracker(), camera_for(image), np.random.default_rng(seed)
    found = []
    for k in range(count):
        gain = 1.0 + BREATHING * np.sin(k / 9.0)
        noisy = np.clip(gain * image + rng.normal(0.0, NOISE, image.shape), 0, 255).astype(np.uint8)
        compressed = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        edges = detector.process(k * FRAME_NS, np.asarray(cv2.imdecode(compressed, 1), np.uint8), camera)
        if edges.status is EdgeStatus.VALID and edges.track_id == 1:
            found.append(edges.pixels)
    return np.stack(found) if found else None


def print_tracks(name: str, tracks: list[npt.NDArray[np.float64] | None]) -> None:
    """Print in how many frames points were found and how still they were."""
    known = [track for track in tracks if track is not None]
    print(f"{name}: points in {len(known)} of {len(tracks)} frames")
    if known:
        jitter = [float(np.sqrt(((t - t.mean(axis=0)) ** 2).sum(axis=-1).mean())) for t in known]
        drift = [float(np.linalg.norm(t[-1] - t[0], axis=-1).max()) for t in known]
        print(
            f"  held still: jitter median {np.median(jitter):.2f} px, worst {max(jitter):.2f} px; "
            f"drift worst {max(drift):.2f} px; {sum(map(len, known))} images valid"
        )


def sheet(tiles: list[Image]) -> Image:
    """Tiles in rows; each row as high as its highest."""
    rows = []
    for first in range(0, len(tiles), COLUMNS):
        row = tiles[first : first + COLUMNS]
        height = max(tile.shape[0] for tile in row)
        padded = [np.pad(tile, ((0, height - tile.shape[0]), (0, 0), (0, 0))) for tile in row]
        padded += [np.zeros((height, TILE_PX, 3), np.uint8)] * (COLUMNS - len(row))
        rows.append(np.hstack(padded))
    return np.vstack(rows)


if __name__ == "__main__":
    sys.exit(main())
