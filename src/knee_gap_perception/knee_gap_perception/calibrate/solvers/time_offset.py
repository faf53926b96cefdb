"""Time offset between video and tracker, from the motion that both observe, without a board.

For any lens, scene and pose of the lens on the body, the affine flow of the image is a linear function of the
body's motion between the two exposures. Its coefficients change only as fast as the depth of the scene. So
for each trial offset, the flow is regressed on the tracked motion, window by window, and the offset with the
smallest residual is chosen.

This is done with coefficients that change linearly and quadratically with time within a window, and with
windows that begin at two phases. The result is the mean of the four, and their variance is part of the
standard error. The other part comes from the residuals: errors of the tracker, in which each pose is part of
two increments, and errors of the coefficients, which persist for some time. So derivatives are summed over
stretches before they are squared. A jackknife over the windows, of which there are few, gave a standard error
that was itself wrong by half.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibrate.measurements.image_motion import ImageMotion
from knee_gap_perception.calibrate.measurements.pose_track import PoseTrack
from knee_gap_perception.errors import PerceptionError

WINDOW = 2.0  # [s] for one regression
MIN_PAIRS = 40  # in a window: its 18 coefficients would fit fewer too well
DEGREES = (1, 2)  # of the coefficients' change with time
PHASES = (0.0, 0.5)  # start of the windows, in lengths of a window
STRETCH = 0.5  # [s] over which residuals may be correlated
SMALL_SHIFT = 5e-4  # [s] step of the numerical derivatives
MIN_WINDOWS = 5
MIN_LEAD = 3.0  # least ratio of the median residual to the one at the best offset; unrelated motion gives 1.2
SCAN_STEP = 0.004  # [s]


@dataclass(frozen=True)
class TimeOffset:
    """`offset` [s]: the tracker's clock reads stamp + offset at the exposure of an image with that stamp.

    `sigma` is its standard error. `explained` is the fraction of the image motion that the tracked motion
    explains; `scan` (n, 2) are the trial offsets [s] and the unexplained fraction of each.
    """

    offset: float
    sigma: float
    explained: float
    window_count: int
    scan: Array


def estimate_time_offset(motion: ImageMotion, track: PoseTrack, *, max_offset: float = 0.25) -> TimeOffset:
    """Offset between the clocks of images and poses, searched within +- `max_offset` [s].

    Raises PerceptionError with advice on the recording if the common recording is too short, if the images do
    not move with the body, or if the optimum is at the edge of the search.
    """
    reach_ns = int((max_offset + 0.05) * 1e9)
    inside = track.covers(motion.start_ns - reach_ns) & track.covers(motion.end_ns + reach_ns)
    pairs = ImageMotion(motion.start_ns[inside], motion.end_ns[inside], motion.flow[inside])
    windows = _windows(pairs, PHASES[0])
    if len(windows) < MIN_WINDOWS:
        raise PerceptionError(
            f"{len(pairs.flow)} pairs of images show motion while the body is tracked, which fill "
            f"{len(windows)} windows of {WINDOW:g} s; at least {MIN_WINDOWS} are needed: record 15 s of a "
            "textured scene at 20 images per second or more while the scope is shaken"
        )
    steps = np.arange(-max_offset, max_offset + SCAN_STEP / 2, SCAN_STEP)
    residuals = _Residuals(pairs, track, windows, np.ones(6), DEGREES[0])
    coarse = np.array([residuals(step).sum() for step in steps])
    # Once the offset is roughly known, components of the flow that fit the motion less well get less weight.
    residuals = residuals.weighted(float(steps[coarse.argmin()]))
    scan = np.array([residuals(step).sum() for step in steps]) / residuals.total
    best = int(scan.argmin())
    lead = float(np.median(scan) / scan[best])
    if lead < MIN_LEAD:
        raise PerceptionError(
            f"the image motion fits the tracked motion at {1e3 * steps[best]:+.0f} ms only {lead:.1f} times "
            f"better than at other offsets; at least {MIN_LEAD:g} times are needed: shake the scope more, "
            "two or three times per second, in front of a stationary scene"
        )
    if best in (0, len(steps) - 1):
        raise PerceptionError(
            f"the best offset is at the edge of the search, {steps[best]:+.3f} s: set --max-offset above "
            f"{max_offset} s"
        )
    offsets, variances = [], []
    for degree, phase in product(DEGREES, PHASES):
        windows = _windows(pairs, phase)
        # Motion in short bursts may fill windows at one phase only.
        if len(windows) < MIN_WINDOWS:
            continue
        one = replace(residuals, degree=degree, windows=windows)
        offsets.append(_minimum(one, float(steps[best])))
        variances.append(one.variance(offsets[-1]))
    offset = float(np.mean(offsets))
    sigma = float(np.sqrt(np.mean(variances) + np.var(offsets)))
    explained = 1 - float(residuals(offset).sum()) / residuals.total
    return TimeOffset(offset, sigma, explained, len(residuals.windows), np.column_stack([steps, scan]))


def _windows(pairs: ImageMotion, phase: float) -> list[npt.NDArray[np.intp]]:
    """Indices of the pairs in each window; windows with few pairs are left out."""
    if len(pairs.flow) == 0:
        return []
    length_ns = int(WINDOW * 1e9)
    number = (pairs.start_ns - pairs.start_ns[0] + int(phase * length_ns)) // length_ns
    windows = [np.flatnonzero(number == i) for i in range(int(number[-1]) + 1)]
    return [window for window in windows if len(window) >= MIN_PAIRS]


@dataclass(frozen=True)
class _Residuals:
    """Squared flow in each window that the tracked motion does not explain, as a function of the offset."""

    pairs: ImageMotion
    track: PoseTrack
    windows: list[npt.NDArray[np.intp]]
    weight: Array
    degree: int

    def __call__(self, offset: float) -> Array:
        """Weighted sums of squares (windows,)."""
        return np.array([(r**2).sum() for r in self._parts(offset)])

    def _parts(self, offset: float) -> list[Array]:
        shift_ns = round(offset * 1e9)
        body = self.track.increments(self.pairs.start_ns + shift_ns, self.pairs.end_ns + shift_ns)
        parts = []
        for window in self.windows:
            flow, motion = self.pairs.flow[window] * self.weight, body[window]
            time = (self.pairs.start_ns[window] - self.pairs.start_ns[window].mean()) / (WINDOW * 1e9)
            design = np.concatenate(
                [motion * time[:, None] ** power for power in range(self.degree + 1)], axis=1
            )
            scale = np.linalg.norm(design, axis=0)
            design = design / np.where(scale > 0, scale, 1)
            parts.append(flow - design @ np.linalg.lstsq(design, flow, rcond=1e-9)[0])
        return parts

    @property
    def total(self) -> float:
        """Weighted sum of squares of the flow itself."""
        return float(sum(((self.pairs.flow[window] * self.weight) ** 2).sum() for window in self.windows))

    def weighted(self, offset: float) -> "_Residuals":
        """The same, with each component weighted by its residual at an offset."""
        left = np.concatenate(self._parts(offset))
        return replace(self, weight=self.weight / np.maximum(left.std(axis=0), 1e-9))

    def variance(self, offset: float) -> float:
        """Variance of the offset of the smallest residual [s^2].

        By the sandwich formula, corrected for the part of the residuals that the coefficients absorb.
        """
        left = np.concatenate(self._parts(offset))
        later, earlier = self._parts(offset + SMALL_SHIFT), self._parts(offset - SMALL_SHIFT)
        rate = (np.concatenate(later) - np.concatenate(earlier)) / (2 * SMALL_SHIFT)
        start_ns = self.pairs.start_ns[np.concatenate(self.windows)]
        stretch = (start_ns - self.pairs.start_ns[0]) // int(STRETCH * 1e9)
        score = np.bincount(stretch, weights=(rate * left).sum(axis=1))
        taken_up = 6 * (self.degree + 1) * len(self.windows)
        freedom = len(left) / (len(left) - taken_up)
        return freedom * float((score**2).sum()) / float((rate**2).sum()) ** 2


def _minimum(residuals: _Residuals, near: float) -> float:
    """Offset of the smallest residual near a given one."""
    span = (near - 2 * SCAN_STEP, near + 2 * SCAN_STEP)
    result = minimize_scalar(
        lambda offset: float(residuals(offset).sum()), bounds=span, method="bounded", options={"xatol": 1e-6}
    )
    return float(result.x)
