"""The bounds of the gap by our search, by scipy and by all pairs: exactness, ratios of time, and a long run.

Every ratio comes from one run on the same clouds, the times taken in turns, one core. Ours includes drawing
the clouds; the others are given them.
"""

import argparse
import math
import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import cdist
from tqdm import tqdm

from knee_gap_uncertainty.numerics.vectors import vector
from knee_gap_uncertainty.two_view.angle_sets import SIGNS, Signs
from knee_gap_uncertainty.two_view.error_cloud import Apex, error_clouds, trace_cloud
from knee_gap_uncertainty.two_view.extremes import extremes
from knee_gap_uncertainty.two_view.gap_range import (
    GapRange,
    axes_along,
    cloud_range,
    gap_range,
    reversed_views,
    warm_up,
)
from knee_gap_uncertainty.two_view.slices import slice_spokes
from knee_gap_uncertainty.two_view.translation_volume import displacements
from knee_gap_uncertainty.two_view.triangulation import triangulate
from knee_gap_uncertainty.two_view.two_views import TwoViews, two_views

Cloud = npt.NDArray[np.float64]

# The paper's first set: image error and rotation together [rad], translation [m].
PSI = math.radians(2.364)
DT = 0.0367e-3
APEXES: tuple[Apex, Apex] = ("first", "second")
ALL_SIGNS: tuple[Signs, ...] = ("none", "same", "opposite", "all")
UPDATES_IN_TEN_MINUTES = 36_000


def unit(vectors: Cloud) -> Cloud:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def random_views(rng: np.random.Generator) -> TwoViews:
    """Two points 2-8 mm apart, 5-20 mm ahead of a lens that moves 4-9 mm sideways."""
    first = np.append(rng.uniform(-2e-3, 2e-3, 2), rng.uniform(5e-3, 20e-3))
    points = np.stack([first, first + unit(rng.normal(size=3) * [1, 1, 0.3]) * rng.uniform(2e-3, 8e-3)])
    travel = unit(rng.normal(size=3) * [1, 1, 0.3]) * rng.uniform(4e-3, 9e-3)
    return two_views(np.zeros(3), travel, unit(points), unit(points - travel))


def by_all_pairs(one: Cloud, other: Cloud) -> tuple[float, float]:
    """Least and greatest distance, in chunks: the quickest that plain numpy does."""
    middle = (one.mean(axis=0) + other.mean(axis=0)) / 2
    one, other = one - middle, other - middle
    squares, nearest, farthest = (other**2).sum(axis=1), math.inf, 0.0
    for start in range(0, len(one), 256):
        chunk = one[start : start + 256]
        squared = (chunk**2).sum(axis=1)[:, None] + squares - 2 * chunk @ other.T
        nearest, farthest = min(nearest, squared.min()), max(farthest, squared.max())
    return math.sqrt(max(nearest, 0.0)), math.sqrt(farthest)


def by_all_pairs_exactly(one: Cloud, other: Cloud) -> tuple[float, float]:
    """The same by differences, to the last digits."""
    nearest, farthest = math.inf, 0.0
    for start in range(0, len(one), 256):
        distances = cdist(one[start : start + 256], other, "sqeuclidean")
        nearest, farthest = min(nearest, distances.min()), max(farthest, distances.max())
    return math.sqrt(nearest), math.sqrt(farthest)


def by_scipy(one: Cloud, other: Cloud) -> tuple[float, float]:
    """Least distance by a k-d tree, greatest over the corners of the convex hulls."""
    nearest = cKDTree(one).query(other)[0].min()
    farthest = cdist(one[ConvexHull(one).vertices], other[ConvexHull(other).vertices]).max()
    return float(nearest), float(farthest)


def ours(
    views: TwoViews, psi: float, shift: float, signs: Signs, apex: Apex, radii: int
) -> tuple[float, float, float]:
    """Least and greatest distance of the samples by the compiled search, and the lower bound of the gap."""
    points = triangulate(views)
    seen = points.points_first if apex == "first" else points.points_second
    turn = axes_along(seen[1] - seen[0])
    views = turned(views if apex == "first" else reversed_views(views), turn)
    shifts = displacements(shift, radii) @ turn.T
    clouds = []
    for n in range(2):
        own, other = vector(views.bearings_0[n]), vector(views.bearings_1[n])
        cloud = trace_cloud(vector(views.travel), own, other, psi, shifts, SIGNS[signs])
        clouds.append(slice_spokes(cloud.points, cloud.starts))
    bound, _, _ = cloud_range(views.travel, views.bearings_0, views.bearings_1, psi, shifts, SIGNS[signs])
    return *extremes(*clouds), bound


def turned(views: TwoViews, turn: Cloud) -> TwoViews:
    """The views in other axes, as gap_range turns them."""
    return TwoViews(
        turn @ views.lens_0, turn @ views.lens_1, views.bearings_0 @ turn.T, views.bearings_1 @ turn.T
    )


def drawn(
    views: TwoViews, psi: float, shift: float, signs: Signs, apex: Apex, radii: int
) -> tuple[Cloud, Cloud]:
    """The same clouds as points, for the others."""
    return error_clouds(
        views, angular_error=psi, translation_error=shift, signs=signs, apex=apex, radii=radii
    )


def exactness(scenes: int, radii: int, reference: Callable[[Cloud, Cloud], tuple[float, float]]) -> str:
    """Largest difference to the reference over scenes, signs and apexes [m]."""
    rng = np.random.default_rng(20)
    worst, compared, overlapping, lowered = 0.0, 0, 0, 0
    for _ in tqdm(range(scenes), desc=f"exactness, radii {radii}", disable=not sys.stderr.isatty()):
        views = random_views(rng)
        psi, shift = rng.uniform(0.002, 0.03), rng.uniform(5e-6, 6e-5)
        for signs, apex in product(ALL_SIGNS, APEXES):
            nearest, farthest, bound = ours(views, psi, shift, signs, apex, radii)
            least, greatest = reference(*drawn(views, psi, shift, signs, apex, radii))
            compared += 1
            overlapping += bound == 0
            lowered += 0 < bound < nearest
            worst = max(worst, abs(nearest - least), abs(farthest - greatest))
    return (
        f"  {scenes} scenes, {compared} pairs of clouds, radii {radii}: largest difference to "
        f"{reference.__name__} {worst:.1e} m (the gap bounded by the volumes: {lowered}, clouds overlap: "
        f"{overlapping})"
    )


def timed(run: Callable[[], object], repeats: int) -> float:
    """Median time [s]."""
    times = []
    for _ in range(repeats):
        start = perf_counter()
        run()
        times.append(perf_counter() - start)
    return float(np.median(times))


def range_of(views: TwoViews, radii: int = 1) -> GapRange:
    """What a node asks for at every image: the better of both apexes, worst case."""
    return gap_range(
        views.lens_0, views.lens_1, views.bearings_0, views.bearings_1,
        angular_error=PSI, translation_error=DT, apex="best", radii=radii,
    )  # fmt: skip


def ratios(radii: int, repeats: int) -> Iterator[str]:
    """Times of both apexes, worst case, for one scene of the paper's first error set."""
    points = np.array([[-1e-3, -2e-3, 10e-3], [-1e-3, 2e-3, 10e-3]])
    lens = np.array([4e-3, 1e-3, 0.0])
    views = two_views(np.zeros(3), lens, unit(points), unit(points - lens))
    clouds = [drawn(views, PSI, DT, "all", apex, radii) for apex in APEXES]
    for apex, pair in zip(APEXES, clouds, strict=True):
        np.testing.assert_allclose(ours(views, PSI, DT, "all", apex, radii)[:2], by_scipy(*pair), atol=1e-12)
    mine, scipys = [], []
    for _ in range(repeats):
        mine.append(timed(lambda: range_of(views, radii), 5))
        scipys.append(timed(lambda: [by_scipy(*pair) for pair in clouds], 1))
    own, scipy = float(np.median(mine)), float(np.median(scipys))
    brute = 2 * timed(lambda: by_all_pairs(*clouds[0]), 1)
    yield f"  radii {radii}: {clouds[0][0].shape[0]} points a cloud, worst_case, both apexes"
    yield f"    gap_range                         {own * 1e3:10.2f} ms"
    yield f"    scipy: cKDTree and ConvexHull     {scipy * 1e3:10.2f} ms   {scipy / own:9.1f} times as long"
    yield f"    numpy: all pairs (twice one apex) {brute * 1e3:10.2f} ms   {brute / own:9.1f} times as long"


def small_errors(scenes: int) -> str:
    """Times where the lens's error is wide beside the image's: the clouds are then no cones but balls."""
    rng = np.random.default_rng(5)
    times = []
    for _ in range(scenes):
        views, psi, shift = random_views(rng), math.radians(rng.uniform(0.1, 0.4)), rng.uniform(5e-5, 2e-4)
        start = thread_time()
        gap_range(
            views.lens_0, views.lens_1, views.bearings_0, views.bearings_1,
            angular_error=psi, translation_error=shift, apex="best",
        )  # fmt: skip
        times.append(1e3 * (thread_time() - start))
    return (
        f"  image error 0.1-0.4 deg, lens 0.05-0.2 mm, {scenes} scenes: "
        f"median {np.median(times):.2f} ms, longest {max(times):.2f} ms"
    )


def resident_mb() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def long_run(updates: int) -> str:
    """Ten minutes at 60 Hz: a lens that wanders for ever, every image a range from both apexes."""
    rng = np.random.default_rng(3)
    points = np.array([[0.0, -2e-3, 10e-3], [0.0, 2e-3, 10e-3]])
    times = np.empty(updates)
    memory = []
    for i in tqdm(range(updates), desc="long run", disable=not sys.stderr.isatty()):
        phase = i / 600
        lens = (
            np.array([4e-3 + 2e-3 * math.cos(phase), 1e-3 * math.sin(phase), 0.0]) + rng.normal(size=3) * 2e-5
        )
        views = TwoViews(np.zeros(3), lens, unit(points), unit(points - lens))
        start = thread_time()
        range_of(views)
        times[i] = thread_time() - start
        if i in (updates // 10, updates - 1):
            memory.append(resident_mb())
    tenth = updates // 10
    early, late = np.median(times[:tenth]) * 1e3, np.median(times[-tenth:]) * 1e3
    return (
        f"  {updates} updates, processor time: median {early:.3f} ms in the first tenth, "
        f"{late:.3f} ms in the last "
        f"(ratio {late / early:.2f}), 99 % below {np.quantile(times, 0.99) * 1e3:.2f} ms; "
        f"memory {memory[0]:.1f} MB after the first tenth, {memory[-1]:.1f} MB at the end"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=10, help="random scenes to compare (10)")
    parser.add_argument(
        "--radii",
        type=int,
        nargs="+",
        help="compare only, with so many radii: 1 with all pairs, more with scipy, which is exact too",
    )
    parser.add_argument("--updates", type=int, default=UPDATES_IN_TEN_MINUTES, help="length of the long run")
    parser.add_argument("--repeats", type=int, default=15, help="repeats of each time taken")
    options = parser.parse_args(argv)
    if options.radii:
        print("exactness of the bounds of the gap")
        for radii in options.radii:
            reference = by_all_pairs_exactly if radii == 1 else by_scipy
            print(exactness(options.scenes, radii, reference), flush=True)
        return 0
    start = perf_counter()
    warm_up()
    print(f"bounds of the gap (warm-up {perf_counter() - start:.2f} s)")
    print(long_run(options.updates), flush=True)
    for line in (*ratios(1, options.repeats), *ratios(4, 3)):
        print(line, flush=True)
    print(small_errors(20 * options.scenes), flush=True)
    print(exactness(options.scenes, 1, by_all_pairs_exactly), flush=True)
    print(exactness(max(1, options.scenes // 10), 4, by_scipy), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
