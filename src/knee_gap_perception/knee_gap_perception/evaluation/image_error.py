"""Image error of a segmented gap: overlap with a marked gap, and errors at the two gap points (paper, II-E).

The paper measures "errors around the two gap points" (figure 4a, Table 2) and defines the procedure by a
figure only. Here:

- The section is that of the *marked* gap: the largest inscribed disc, and through its centre the direction in
  which the gap is narrowest. G0 and G1 are the ends of the marked gap along that direction; G0 is the upper
  one, or the left one of two at the same height.
- Around each point, on lines parallel to the section up to the disc's radius on either side, the distance
  along the line between the end of the marked gap and the end of the predicted gap is measured: the white
  areas of figure 4a. On a line, the predicted gap consists of all its runs of pixels that overlap the marked
  run, so a hole inside is not an error of the edge.
- The error of a point is the RMS over its lines, in pixels, and as the angle between the two ends by the
  camera model. Lines without a prediction have no error; their fraction is reported as `missed`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Mask
from knee_gap_perception.camera.camera import Camera
from knee_gap_perception.errors import PerceptionError

DIRECTIONS = 180
STEP_PX = 0.25  # along a line
LINES = 41  # across each gap point
MIN_RADIUS_PX = 2.0


class Overlap(NamedTuple):
    """Pixels of true and false positives and negatives."""

    tp: int
    fp: int
    fn: int
    tn: int

    @property
    def dice(self) -> float:
        """2 TP / (2 TP + FP + FN); 1 if both masks are empty."""
        total = 2 * self.tp + self.fp + self.fn
        return 2 * self.tp / total if total else 1.0


@dataclass(frozen=True)
class EdgeError:
    """RMS error at G0 and G1 (2,) in pixels and as an angle [rad], NaN without a prediction there.

    `points` (2, 2) are the gap points in the marked mask [px]; `squares_px` and `squares` (2, LINES) the
    squared error of each line, NaN if the line has none; `missed` (2,) the fraction of lines without a
    prediction.
    """

    points: Array
    squares_px: Array
    squares: Array

    @property
    def rms_px(self) -> Array:
        """RMS error (2,) [px]."""
        return rms(self.squares_px)

    @property
    def rms(self) -> Array:
        """RMS error (2,) [rad]."""
        return rms(self.squares)

    @property
    def missed(self) -> Array:
        """Fraction (2,) of lines without a predicted gap."""
        return np.asarray(np.isnan(self.squares_px).mean(axis=1))


def rms(squares: Array) -> Array:
    """Root of the mean over the last axis, ignoring NaN; NaN if all are NaN."""
    known = np.isfinite(squares)
    count = known.sum(axis=-1)
    total = np.where(known, squares, 0.0).sum(axis=-1)
    return np.asarray(np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan)))


def overlap(predicted: Mask, marked: Mask) -> Overlap:
    """Counts of pixels in which masks (h, w) agree and differ. Raises PerceptionError if sizes differ."""
    if predicted.shape != marked.shape:
        raise PerceptionError(
            f"masks must have one size, not {predicted.shape[1]}x{predicted.shape[0]} px predicted and "
            f"{marked.shape[1]}x{marked.shape[0]} px marked"
        )
    tp, fp = int((predicted & marked).sum()), int((predicted & ~marked).sum())
    fn = int((~predicted & marked).sum())
    return Overlap(tp, fp, fn, predicted.size - tp - fp - fn)


def edge_error(predicted: Mask, marked: Mask, camera: Camera) -> EdgeError | None:
    """Error of a predicted gap (h, w) at the two points of the marked one; None if no gap is marked.

    Raises PerceptionError for masks of different size, or another size than the camera's.
    """
    overlap(predicted, marked)
    if marked.shape != (camera.height_px, camera.width_px):
        raise PerceptionError(
            f"the camera is for images of {camera.width_px}x{camera.height_px} px, not "
            f"{marked.shape[1]}x{marked.shape[0]} px"
        )
    section = _section(marked)
    if section is None:
        return None
    centre, across, radius = section
    along = np.array([-across[1], across[0]])
    reach = np.hypot(marked.shape[0], marked.shape[1])
    distance = np.arange(-reach, reach, STEP_PX)
    starts = centre + np.linspace(-radius, radius, LINES)[:, None] * along
    ends = np.full((LINES, 2, 2, 2), np.nan)  # line, mask (marked, predicted), end, column and row
    for i, start in enumerate(starts):
        line = start + distance[:, None] * across
        runs = _runs(_sampled(marked, line))
        # Of the marked runs on a line, use the one nearest to the section's centre.
        marked_run = min(runs, key=lambda run: _away(run, len(line) // 2), default=None)
        if marked_run is None:
            continue
        ends[i, 0] = line[[marked_run[0], marked_run[1] - 1]]
        touching = [run for run in _runs(_sampled(predicted, line)) if _overlap(run, marked_run)]
        if touching:
            ends[i, 1] = line[[touching[0][0], touching[-1][1] - 1]]
    gap = ends[:, 1] - ends[:, 0]
    bearings = camera.bearings(ends)
    chord = np.linalg.norm(bearings[:, 1] - bearings[:, 0], axis=-1)
    angles = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    points = ends[LINES // 2, 0]
    return EdgeError(points, (gap**2).sum(axis=-1).T, (angles**2).T)


def _section(marked: Mask) -> tuple[Array, Array, float] | None:
    """Centre (2,) and radius [px] of the largest inscribed disc, and the unit vector across the gap there."""
    padded = np.pad(marked.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    _, radius, _, (column, row) = cv2.minMaxLoc(depth)
    if radius < MIN_RADIUS_PX:
        return None
    centre = np.array([column - 1.0, row - 1.0])
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    reach = np.arange(0.0, np.hypot(marked.shape[0], marked.shape[1]), 0.5)
    width = np.zeros(DIRECTIONS)
    for side in (1.0, -1.0):
        inside = _sampled(marked, centre + side * reach[:, None] * directions[:, None, :])
        width += np.where(inside.all(axis=1), np.inf, (~inside).argmax(axis=1))
    # Of equally narrow directions, use the middle one.
    narrow = directions[width <= width.min() + 1]
    across = narrow[0] if len(narrow) == 1 else _mean_axis(narrow)
    # From the upper or left end to the other, so that G0 is the first.
    if across[1] < -1e-9 or (abs(across[1]) <= 1e-9 and across[0] < 0):
        across = -across
    return centre, across, float(radius)


def _mean_axis(directions: Array) -> Array:
    """Mean of directions without sign."""
    values, vectors = np.linalg.eigh(directions.T @ directions)
    return np.asarray(vectors[:, values.argmax()])


def _sampled(mask: Mask, pixels: Array) -> Mask:
    """The mask at the nearest pixels (..., 2); False outside the image."""
    nearest = np.rint(pixels).astype(int)
    column, row = nearest[..., 0], nearest[..., 1]
    inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    found = np.zeros(inside.shape, dtype=bool)
    found[inside] = mask[row[inside], column[inside]]
    return found


def _runs(line: Mask) -> list[tuple[int, int]]:
    """Start and end of each run of True."""
    edges = np.diff(np.concatenate([[0], line.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True))


def _away(run: tuple[int, int], middle: int) -> int:
    """Number of samples between a run and the middle of a line; 0 if the run contains it."""
    return max(run[0] - middle, middle - run[1] + 1, 0)


def _overlap(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether two runs share a sample."""
    return first[0] < second[1] and second[0] < first[1]
