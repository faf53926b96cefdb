"""The fit over all views, per update, beside scipy's general solver on the same residuals."""

import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from knee_gap_uncertainty.confidence_interval import confidence_interval
from knee_gap_uncertainty.multi_view import fit
from knee_gap_uncertainty.views import Views

POINTS = np.array([[0.0, -0.002, 0.010], [0.0005, 0.002, 0.011]])
SIGMA_BEARING, SIGMA_LENS, SIGMA_TURN = np.radians(0.3), 2.1e-5, 4e-5


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


def main() -> int:
    """Print a row for each number of views."""
    print("views  fit [ms]  fit and interval [ms]  scipy least_squares [ms]  ratio to scipy")
    for count in (2, 60, 240):
        views = simulated_views(count, seed=count)
        fit(views)
        alone = milliseconds(lambda v=views: fit(v), 50)  # type: ignore[misc]
        whole = milliseconds(lambda v=views: confidence_interval(fit(v), 0.95), 50)  # type: ignore[misc]
        rival = milliseconds(lambda v=views: by_scipy(v), 7)  # type: ignore[misc]
        print(f"{count:5d}  {alone:8.3f}  {whole:21.3f}  {rival:24.2f}  {rival / alone:14.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
