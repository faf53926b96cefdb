"""The fit over all views, per update, beside scipy's general solver on the same residuals."""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from knee_gap_uncertainty.multi_view.confidence_interval import confidence_interval
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit
from knee_gap_uncertainty.multi_view.views import Views

POINTS = np.array([[0.0, -0.002, 0.010], [0.0005, 0.002, 0.011]])
SIGMA_BEARING, SIGMA_LENS, SIGMA_TURN = np.radians(0.3), 2.1e-5, 4e-5

# Times the deviation of a bearing at which a common offset is taken to the second order.
LARGE = 9.0


def simulated_views(count: int, seed: int) -> Views:
    """Views of two points 4 mm apart from a lens that travels 8 mm past them, with noise."""
    rng = np.random.default_rng(seed)
    true_lens = np.column_stack([np.linspace(-0.004, 0.004, count), *rng.normal(0.0, 2e-4, (2, count))])
    towards = POINTS - true_lens[:, None, :]
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    planes = np.eye(3) - bearings[..., :, None] * bearings[..., None, :]
    noisy = bearings + np.einsum("nkij,nkj->nki", planes, rng.normal(0.0, SIGMA_BEARING, bearings.shape))
    return Views(
        lens_positions=true_lens + rng.normal(0.0, SIGMA_LENS, true_lens.shape),
        bearings=noisy / np.linalg.norm(noisy, axis=-1, keepdims=True),
        bearing_covariances=SIGMA_BEARING**2 * planes,
        lens_covariances=np.tile(SIGMA_LENS**2 * np.eye(3), (count, 1, 1)),
        rotation_covariances=np.tile(SIGMA_TURN**2 * np.eye(3), (count, 1, 1)),
        common_share=0.0,
        lens_rotations=np.tile(np.eye(3), (count, 1, 1)),
    )


def by_scipy(views: Views) -> float:
    """Gap [m] by scipy's least squares, points and bearings only, as a general solver would be used."""

    def residuals(values: "np.typing.NDArray[np.float64]") -> "np.typing.NDArray[np.float64]":
        towards = values.reshape(1, 2, 3) - views.lens_positions[:, None, :]
        directions = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
        return np.asarray(np.cross(directions, views.bearings).ravel() / SIGMA_BEARING)

    start = views.lens_positions.mean(axis=0) + 0.01 * views.bearings.mean(axis=0)
    found = least_squares(residuals, start.ravel(), method="lm").x.reshape(2, 3)
    return float(np.linalg.norm(found[1] - found[0]))


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call [ms]."""
    times = []
    for _ in range(repeats):
        begin = time.process_time_ns()
        function()
        times.append((time.process_time_ns() - begin) * 1e-6)
    return float(np.median(times))


def moved_by_an_outlier(runs: int, seed: int) -> Iterator[str]:
    """How far one bearing in 30 that is 5 standard deviations off moves the gap, cell by cell.

    The same tracks with and without it, in units of the width of the 95 % interval without it.
    """
    yield "sigma [deg]  travel [mm]  common   moved by more than 1/4 of the interval   median   99 % below"
    everything = []
    for cell, (sigma_deg, travel, share) in enumerate(product((0.3, 1.18), (4e-3, 8e-3), (0.0, 0.5))):
        rng = np.random.default_rng([seed, cell])
        moved: list[float] = []
        while len(moved) < runs:
            views = outlier_views(np.radians(sigma_deg), travel, share, rng)
            clean = fit(views)
            interval = confidence_interval(clean, 0.95)
            if interval.refused:
                continue
            i, n, angle = rng.integers(30), rng.integers(2), 2.0 * np.pi * rng.random()
            bearing = views.bearings[i, n]
            right = np.cross([0.0, 1.0, 0.0], bearing)
            right /= np.linalg.norm(right)
            aside = np.cos(angle) * right + np.sin(angle) * np.cross(bearing, right)
            bearings = views.bearings.copy()
            bearings[i, n] = bearing + np.tan(5.0 * np.radians(sigma_deg)) * aside
            bearings[i, n] /= np.linalg.norm(bearings[i, n])
            gap = fit(replace(views, bearings=bearings)).gap
            moved.append(abs(gap - clean.gap) / (interval.upper - interval.lower))
        shares = np.array(moved)
        everything.append(shares)
        far = 100 * np.mean(~(shares <= 0.25))
        yield (
            f"{sigma_deg:11.2f}  {1e3 * travel:11.0f}  {share:6.1f}  {far:30.2f} %"
            f"  {np.median(shares):16.3f}  {np.quantile(shares, 0.99):10.3f}"
        )
    whole = np.concatenate(everything)
    yield f"all: {100 * np.mean(~(whole <= 0.25)):.2f} % of {len(whole)} tracks"


def outlier_views(sigma: float, travel: float, share: float, rng: np.random.Generator) -> Views:
    """30 views of two points 4 mm apart, 10 mm ahead; `share` of the bearings' variance is one offset."""
    count = 30
    true_lens = np.column_stack(
        [np.linspace(-travel / 2, travel / 2, count), *rng.normal(0.0, 2e-4, (2, count))]
    )
    towards = POINTS - true_lens[:, None, :]
    bearings = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    planes = np.eye(3) - bearings[..., :, None] * bearings[..., None, :]
    error = np.sqrt(1.0 - share) * rng.normal(0.0, sigma, bearings.shape)
    error += np.sqrt(share) * rng.normal(0.0, sigma, (1, 2, 3))
    noisy = bearings + np.einsum("nkij,nkj->nki", planes, error)
    return Views(
        lens_positions=true_lens + rng.normal(0.0, SIGMA_LENS, true_lens.shape),
        bearings=noisy / np.linalg.norm(noisy, axis=-1, keepdims=True),
        bearing_covariances=sigma**2 * planes,
        lens_covariances=np.tile(SIGMA_LENS**2 * np.eye(3), (count, 1, 1)),
        rotation_covariances=np.tile(SIGMA_TURN**2 * np.eye(3), (count, 1, 1)),
        common_share=share,
        lens_rotations=np.tile(np.eye(3), (count, 1, 1)),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print a row for each number of views, or what a bad bearing does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--outliers", type=int, metavar="RUNS", help="tracks of each cell with a bad bearing")
    parser.add_argument("--seed", type=int, default=1, help="seed of those tracks (1)")
    options = parser.parse_args(argv)
    if options.outliers:
        for line in moved_by_an_outlier(options.outliers, options.seed):
            print(line, flush=True)
        return 0
    print("views  fit [ms]  fit and interval [ms]  scipy least_squares [ms]  ratio to scipy")
    for count in (2, 60, 240):
        views = simulated_views(count, seed=count)
        fit(views)
        alone = milliseconds(lambda v=views: fit(v), 50)  # type: ignore[misc]
        whole = milliseconds(lambda v=views: confidence_interval(fit(v), 0.95), 50)  # type: ignore[misc]
        rival = milliseconds(lambda v=views: by_scipy(v), 7)  # type: ignore[misc]
        print(f"{count:5d}  {alone:8.3f}  {whole:21.3f}  {rival:24.2f}  {rival / alone:14.1f}")
    large = replace(views, bearing_covariances=LARGE**2 * views.bearing_covariances, common_share=1.0)
    whole = milliseconds(lambda: confidence_interval(fit(large), 0.95), 50)
    print(f"{len(large):5d} views, common offset of {LARGE * 0.3:.1f} deg: fit and interval {whole:.3f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
