"""A bag's images and poses to be sent live: as CDR, forwards and backwards by turns, with present stamps."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.writing.bag_writer import serialized
from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

# How long after its stamp each message is received, as in the sample bag [s].
LATENCY = {IMAGE: 0.008, CAMERA_INFO: 0.008, BODY_POSE: 0.003}


class Played(NamedTuple):
    """A message as CDR, and its stamp after the first [s]."""

    topic: str
    data: bytes
    stamp: float


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """A serialised message with another stamp [ns]: a header stands first in it."""
    seconds, rest = divmod(stamp_ns, 10**9)
    return data[:4] + seconds.to_bytes(4, "little") + rest.to_bytes(4, "little") + data[12:]


def of_bag(bag: Path, rows: int = 0) -> list[Played]:
    """The messages of a bag by their stamps; with `rows`, images of that height [px]. Raises BagError."""
    read: list[tuple[str, bytes, int]] = []
    with BagReader(bag) as reader:
        for entry in reader.messages(list(LATENCY)):
            data = bytes(entry.data)
            if rows and entry.topic != BODY_POSE:
                message = _scaled(reader.deserialize(entry), rows, is_image=entry.topic == IMAGE)
                data = serialized(message, entry.msgtype)
            read.append((entry.topic, data, int(reader.stamp_ns(entry) or 0)))
    first = min(stamp for _, _, stamp in read)
    # A camera model is received before the image of its stamp.
    read.sort(key=lambda one: (one[2], one[0] == IMAGE))
    return [Played(topic, data, 1e-9 * (stamp - first)) for topic, data, stamp in read]


def to_and_fro(messages: list[Played], seconds: float) -> Iterator[Played]:
    """The messages by their stamps, then backwards, and so on, for a time [s]."""
    length = max(one.stamp for one in messages) + 1.0 / 120.0
    last = length - 1.0 / 120.0
    for turn in itertools.count():
        for one in messages if turn % 2 == 0 else _backwards(messages):
            stamp = turn * length + (one.stamp if turn % 2 == 0 else last - one.stamp)
            if stamp >= seconds:
                return
            yield one._replace(stamp=stamp)


def _backwards(messages: list[Played]) -> list[Played]:
    return sorted(messages, key=lambda one: (-one.stamp, one.topic == IMAGE))


def _scaled(message: Any, rows: int, *, is_image: bool) -> Any:
    """An image or its camera model at another height, with the same field of view."""
    if is_image:
        pixels = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR)
        columns = round(pixels.shape[1] * rows / pixels.shape[0])
        larger = cv2.resize(pixels, (columns, rows), interpolation=cv2.INTER_CUBIC)
        message.data = cv2.imencode(".jpg", larger)[1]
        return message
    factor = rows / message.height
    message.width, message.height = round(message.width * factor), rows
    for name in ("k", "p"):
        numbers = np.array(getattr(message, name), dtype=np.float64).reshape(3, -1)
        # Pixels are counted from their centres.
        numbers[:2, 2] = (numbers[:2, 2] + 0.5) * factor - 0.5
        numbers[[0, 1], [0, 1]] *= factor
        setattr(message, name, numbers.ravel())
    return message
