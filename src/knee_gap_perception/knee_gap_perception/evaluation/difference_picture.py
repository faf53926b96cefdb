"""Difference picture of a segmented and a marked gap, in the colours of the paper's figure 8d."""

from collections.abc import Sequence

import cv2
import numpy as np

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.evaluation.image_error import EdgeError

# Blue, green, red: true positives green, true negatives grey, false positives red, false negatives blue.
TP, TN, FP, FN = (60, 170, 60), (128, 128, 128), (50, 50, 220), (220, 90, 40)
PANEL_ROWS = 240


def difference_picture(predicted: Mask, marked: Mask, error: EdgeError | None = None) -> Image:
    """Colours of agreement (h, w, 3), blue green red; the gap points are drawn if an error is given."""
    picture = np.empty((*marked.shape, 3), dtype=np.uint8)
    picture[predicted & marked], picture[~predicted & ~marked] = TP, TN
    picture[predicted & ~marked], picture[~predicted & marked] = FP, FN
    if error is not None and np.isfinite(error.points).all():
        size = max(3, marked.shape[0] // 120)
        for index, point in enumerate(error.points):
            at = (round(float(point[0])), round(float(point[1])))
            cv2.circle(picture, at, size, (255, 255, 255), max(1, size // 3), cv2.LINE_AA)
            label = (at[0] + 2 * size, at[1] + (-size if index == 0 else 3 * size))
            cv2.putText(
                picture,
                f"G{index}",
                label,
                cv2.FONT_HERSHEY_SIMPLEX,
                size / 8,
                (255, 255, 255),
                1,
                cv2.LINE_AA,
            )
    return picture


def panel(name: str, images: Sequence[Image | Mask]) -> Image:
    """Pictures side by side at one height, with a name: a row of figure 8."""
    parts = []
    for image in images:
        width = round(image.shape[1] * PANEL_ROWS / image.shape[0])
        parts.append(cv2.resize(_coloured(image), (width, PANEL_ROWS), interpolation=cv2.INTER_AREA))
    row = np.hstack(parts)
    cv2.putText(row, name, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(row, dtype=np.uint8)


def _coloured(image: Image | Mask) -> Image:
    grey = image.astype(np.uint8) * 255 if image.dtype == np.bool_ else image.astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if grey.ndim == 2 else grey, dtype=np.uint8)
