"""Motion between consecutive images: shift, zoom, rotation and shear, without a board."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.image.field_of_view import FieldOfViewFinder

WORKING_ROWS = 360
MAX_FEATURES = 300
MIN_FEATURES = 25
WINDOW_PX = (15, 15)
MAX_INTERVAL = 0.2  # [s] largest interval between two images that are compared
EDGE_MARGIN = 0.06  # of the field's radius: its border does not move with the scene


class ImageMotion(NamedTuple):
    """Motion between pairs of images: stamps (n,) of both, and six numbers (n, 6) of an affine flow.

    Shift of the centre in x and y, then d(shift)/dx, d/dy of both, all in radii of the field of view.
    """

    start_ns: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]
    flow: Array


def image_motion(images: Iterable[tuple[int, npt.NDArray[np.uint8]]]) -> ImageMotion:
    """Motion between consecutive images (h, w, 3), given with their stamps [ns]; bad pairs are left out."""
    finder, before = FieldOfViewFinder(), None
    starts, ends, flows = [], [], []
    for stamp_ns, image in images:
        field = finder.find(image)
        if field is None:
            before = None
            continue
        scale = WORKING_ROWS / image.shape[0]
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if before is not None and 0 < stamp_ns - before[0] <= MAX_INTERVAL * 1e9:
            mask = field.mask((grey.shape[0], grey.shape[1]), scale, margin=EDGE_MARGIN * field.extent)
            centre = (np.array(field.centre) + 0.5) * scale - 0.5
            flow = _affine_flow(before[1], grey, mask, centre, field.extent * scale)
            if flow is not None:
                starts.append(before[0])
                ends.append(stamp_ns)
                flows.append(flow)
        before = (stamp_ns, grey)
    return ImageMotion(
        np.array(starts, dtype=np.int64), np.array(ends, dtype=np.int64), np.array(flows).reshape(-1, 6)
    )


def _affine_flow(
    before: npt.NDArray[np.uint8],
    after: npt.NDArray[np.uint8],
    mask: npt.NDArray[np.bool_],
    centre: Array,
    radius: float,
) -> Array | None:
    points = cv2.goodFeaturesToTrack(before, MAX_FEATURES, 0.005, 6, mask=mask.astype(np.uint8))
    if points is None or len(points) < MIN_FEATURES:
        return None
    moved, found = _followed(before, after, points)
    back, found_back = _followed(after, before, moved)
    good = found & found_back & (np.linalg.norm(back - points, axis=2).ravel() < 0.3)
    if good.sum() < MIN_FEATURES:
        return None
    position = (points[good, 0] - centre) / radius
    shift = (moved[good, 0] - points[good, 0]) / radius
    return _robust_affine(np.asarray(position, dtype=np.float64), np.asarray(shift, dtype=np.float64))


def _followed(
    before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8], points: Any
) -> tuple[Any, npt.NDArray[np.bool_]]:
    """Positions of points (n, 1, 2) of one image in another, and which were found (n,)."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.empty(0), winSize=WINDOW_PX, maxLevel=3
    )
    return moved, np.asarray(found).ravel().astype(bool)


def _robust_affine(position: Array, shift: Array) -> Array | None:
    """Affine fit (6,) by reweighted least squares (Cauchy), since glare and debris move differently."""
    design = np.column_stack([np.ones(len(position)), position])
    weight, solution = np.ones(len(position)), np.zeros((3, 2))
    for _ in range(8):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(root * design, root * shift, rcond=None)[0]
        length = np.linalg.norm(shift - design @ solution, axis=1)
        weight = 1 / (1 + (length / max(1.5 * float(np.median(length)), 1e-6)) ** 2)
    return np.concatenate([solution[0], solution[1:].T.ravel()]) if np.isfinite(solution).all() else None
