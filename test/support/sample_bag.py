"""The sample bag of the repository, and what tests take from it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from knee_gap_core.bag.bag import BagReader
from knee_gap_simulation.recordings.recording import CAMERA_INFO, IMAGE

SAMPLE = Path(__file__).parents[2] / "bags" / "sample"


def sample_images(count: int) -> list[Any]:
    """Return the first images (h, w, 3), decoded."""
    with BagReader(SAMPLE) as bag:
        messages = [
            bag.deserialize(entry) for entry, _ in zip(bag.messages([IMAGE]), range(count), strict=False)
        ]
    return [cv2.imdecode(np.asarray(message.data), cv2.IMREAD_COLOR) for message in messages]


def sample_camera_info() -> Any:
    """Return the first CameraInfo."""
    with BagReader(SAMPLE) as bag:
        return bag.deserialize(next(iter(bag.messages([CAMERA_INFO]))))
