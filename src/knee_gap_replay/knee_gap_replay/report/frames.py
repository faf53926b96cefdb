"""Frames of a recording with the gap's edges drawn on them."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.bag.bag import BagMessage, BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.conversions.edge_messages import edges_from_message
from knee_gap_core.values.arrays import Array, Image
from knee_gap_core.values.edges import GapEdges
from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_perception.edge_tracking.overlay import draw_overlay
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.messages import image_from_compressed, image_from_message
from knee_gap_replay.report.results import Results

_WIDTH = 640
_QUALITY = 85
# The surround: grey levels up to this, and rows and columns of which less than this fraction is brighter.
_BLACK, _LEAST_LIT = 40, 0.01
_NO_MASK = np.zeros((0, 0), np.uint8)


class Frame(NamedTuple):
    """A picture as JPEG, empty if the image cannot be read; `flaw` is the reason."""

    stamp_ns: int
    jpeg: bytes
    flaw: str = ""


def choose_stamps(results: Results, most: int) -> list[int]:
    """Stamps [ns] of the images to show: one of each status, the others evenly over the VALID ones."""
    of_images = np.isfinite(results.time) & (results.track_ids > 0)
    chosen: list[int] = []
    values, counts = np.unique(results.status[of_images & ~results.valid], return_counts=True)
    for value in values[np.argsort(-counts, kind="stable")][: most // 2]:
        which = np.flatnonzero(of_images & (results.status == value))
        chosen.append(int(results.stamps_ns[which[len(which) // 2]]))
    valid = np.flatnonzero(of_images & (results.status == GapStatus.VALID))
    if valid.size and most > len(chosen):
        places = np.unique(np.linspace(0, valid.size - 1, most - len(chosen)).round().astype(int))
        chosen += [int(results.stamps_ns[valid[place]]) for place in places]
    return sorted(set(chosen))


def draw_frames(
    recording: Path, image_topic: str, results: Path, edges_topic: str, stamps: Collection[int]
) -> list[Frame]:
    """Draw the images of the given stamps [ns]; images that the recording lacks are left out.

    Raises BagError for a bag that cannot be read.
    """
    if not stamps:
        return []
    with BagReader(results) as bag:
        edges = _edges(bag, edges_topic, stamps)
    frames: dict[int, Frame] = {}
    with BagReader(recording) as bag:
        if image_topic not in bag.topics:
            return []
        for entry in bag.messages([image_topic]):
            stamp = bag.stamp_ns(entry)
            if stamp is not None and stamp in stamps and stamp not in frames:
                frames[stamp] = _frame(bag, entry, stamp, edges)
                if len(frames) == len(stamps):
                    break
    return [frames[stamp] for stamp in sorted(frames)]


def _edges(bag: BagReader, topic: str, stamps: Collection[int]) -> dict[int, GapEdges]:
    if topic not in bag.topics:
        return {}
    found: dict[int, GapEdges] = {}
    for entry in bag.messages([topic]):
        stamp = bag.stamp_ns(entry)
        if stamp is not None and stamp in stamps:
            found[stamp] = edges_from_message(bag.deserialize(entry))
    return found


def _frame(bag: BagReader, entry: BagMessage, stamp: int, edges: Mapping[int, GapEdges]) -> Frame:
    try:
        message = bag.deserialize(entry)
        is_compressed = entry.msgtype == "sensor_msgs/msg/CompressedImage"
        image = (image_from_compressed if is_compressed else image_from_message)(message)
    except (BagError, PerceptionError) as error:
        return Frame(stamp, b"", str(error))
    corner, image = _picture(image)
    if stamp in edges:
        image = draw_overlay(image, _moved(edges[stamp], corner), _NO_MASK, "")
    return Frame(stamp, _jpeg(image))


def _picture(image: Image) -> tuple[Array, Image]:
    """The part of an image inside the black surround of the scope, and its first pixel (2,) [px]."""
    lit = image.max(axis=2) > _BLACK
    columns, rows = (np.flatnonzero(lit.mean(axis=axis) > _LEAST_LIT) for axis in (0, 1))
    if not columns.size or not rows.size:
        return np.zeros(2), image
    corner = np.array([columns[0], rows[0]], dtype=float)
    return corner, np.ascontiguousarray(image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])


def _moved(edges: GapEdges, corner: Array) -> GapEdges:
    """The same edges in an image that begins at a pixel (2,) [px] of theirs."""
    section = replace(edges.section, pixels=edges.section.pixels - corner)
    return replace(edges, pixels=edges.pixels - corner, section=section)


def _jpeg(image: Image) -> bytes:
    scale = min(1.0, _WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
