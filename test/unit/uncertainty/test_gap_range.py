"""gap_range against an independent program that tries all pairs, and by the laws it must obey."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vectors import unit

from knee_gap_uncertainty.two_view.gap_range import cloud_range, gap_range, warm_up

PSI = math.radians(2.364)
DT = 0.0367e-3


def scene(rng, *, gap=None, depth=None, travel=None):
    """Two points in front of a lens that moves sideways: lens positions and exact bearings, in metres."""
    depth = rng.uniform(5e-3, 20e-3) if depth is None else depth
    first = np.array([0, 0, depth]) + rng.uniform(-2e-3, 2e-3, 3)
    sideways = np.append(rng.normal(size=2), rng.uniform(-0.3, 0.3))
    points = np.stack([first, first + unit(sideways) * (rng.uniform(2e-3, 8e-3) if gap is None else gap)])
    step = np.append(rng.normal(size=2), rng.uniform(-0.3, 0.3))
    lens_0 = rng.uniform(-1e-3, 1e-3, 3)
    lens_1 = lens_0 + unit(step) * (rng.uniform(4e-3, 9e-3) if travel is None else travel)
    return lens_0, lens_1, unit(points - lens_0), unit(points - lens_1), points


def errors(rng):
    return {"angular_error": rng.uniform(0.002, 0.03), "translation_error": rng.uniform(5e-6, 6e-5)}


def cloud_by_the_book(lens_0, lens_1, own, other, psi, radii_m, signs):
    """All points of the cloud of one ray from lens_0, drawn one by one as the specification reads."""
    directions = {}
    for elevation, azimuth in product(np.linspace(-np.pi / 2, np.pi / 2, 4), np.linspace(-np.pi, np.pi, 6)):
        cos = math.cos(elevation)
        r = np.array([math.sin(azimuth) * cos, math.cos(azimuth) * cos, math.sin(elevation)])
        directions[tuple(np.round(r, 9) + 0.0)] = r
    assert len(directions) == 12
    moves = [radius * r for radius in radii_m for r in directions.values()]
    dp = np.repeat(moves, len(moves), axis=0)
    dq = np.tile(moves, (len(moves), 1))
    t = lens_1 - lens_0 + dq - dp
    length = np.linalg.norm(t, axis=1)
    alpha = np.arccos(t @ own / length)
    beta = np.arccos(-t @ other / length)
    w = unit(np.cross(own, np.cross(t, own)))
    v = np.cross(own, w)
    cloud = []
    for sign_own, sign_other in signs:
        a, b = alpha + sign_own * psi, beta + sign_other * psi
        reach = (length * np.sin(b) / np.sin(a + b))[:, None]
        for s, phi in product((1, -1), (0, math.pi / 6, math.pi / 4, math.pi / 2)):
            turned = math.cos(phi) * w + math.sin(phi) * v
            cloud.append(lens_0 + dp + reach * (math.cos(psi) * own + s * math.sin(psi) * turned))
    return np.concatenate(cloud)


def extremes_by_all_pairs(one, other):
    nearest, farthest = math.inf, 0.0
    for start in range(0, len(one), 256):
        chunk = one[start : start + 256]
        squared = sum((chunk[:, axis, None] - other[:, axis]) ** 2 for axis in range(3))
        nearest, farthest = min(nearest, squared.min()), max(farthest, squared.max())
    return math.sqrt(nearest), math.sqrt(farthest)


def range_by_the_book(scene, psi, dt, *, interval, apex, radii):
    lens_0, lens_1, bearings_0, bearings_1, _ = scene
    if apex == "second":
        lens_0, lens_1, bearings_0, bearings_1 = lens_1, lens_0, bearings_1, bearings_0
    signs = [(0, 0)] if interval == "paper" else list(product((1, -1), repeat=2))
    radii_m = dt * np.arange(1, radii + 1) / radii
    return extremes_by_all_pairs(
        *(
            cloud_by_the_book(lens_0, lens_1, own, other, psi, radii_m, signs)
            for own, other in zip(bearings_0, bearings_1, strict=True)
        )
    )


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("interval", ["paper", "worst_case"])
def test_equals_all_pairs_on_the_outer_shell(seed, interval):
    rng = np.random.default_rng([1, seed])
    view, error = scene(rng), errors(rng)
    for apex in ("first", "second"):
        found = gap_range(*view[:4], **error, interval=interval, apex=apex)
        expected = range_by_the_book(view, *error.values(), interval=interval, apex=apex, radii=1)
        assert (found.gap_min, found.gap_max) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("radii", [2, 4])
def test_equals_all_pairs_within_the_volume(radii):
    rng = np.random.default_rng([2, radii])
    view, error = scene(rng), errors(rng)
    found = gap_range(*view[:4], **error, interval="paper", radii=radii)
    expected = range_by_the_book(view, *error.values(), interval="paper", apex="first", radii=radii)
    assert (found.gap_min, found.gap_max) == pytest.approx(expected, abs=1e-12)


def test_gap_of_exact_bearings_is_the_distance_of_the_points():
    rng = np.random.default_rng(3)
    for _ in range(50):
        *view, points = scene(rng)
        for apex in ("first", "second", "best"):
            found = gap_range(*view, **errors(rng), apex=apex)
            assert found.gap == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=1e-10)
            assert found.gap_min < found.gap < found.gap_max
            assert found.snr == pytest.approx(found.gap / (found.gap_max - found.gap_min), rel=1e-12)


def moved(view, rotation=None, shift=0.0, factor=1.0):
    rotation = Rotation.identity() if rotation is None else rotation
    lens_0, lens_1, bearings_0, bearings_1, _ = view
    lenses = (factor * rotation.apply(lens) + shift for lens in (lens_0, lens_1))
    return *lenses, rotation.apply(bearings_0), rotation.apply(bearings_1)


def test_rigid_motion_changes_nothing():
    """Exactly so for a shift and for a turn that the grid of displacements shares; nearly so for any turn."""
    rng = np.random.default_rng(4)
    about_z = Rotation.from_euler("z", 72, degrees=True)
    for _ in range(20):
        view, error = scene(rng), errors(rng)
        still = gap_range(*view[:4], **error)
        shifted = gap_range(*moved(view, about_z, rng.uniform(-1, 1, 3)), **error)
        assert shifted == pytest.approx(still, rel=1e-9)
        turn = Rotation.random(random_state=int(rng.integers(1 << 31)))
        without = {"angular_error": error["angular_error"], "translation_error": 0.0}
        assert gap_range(*moved(view, turn), **without) == pytest.approx(
            gap_range(*view[:4], **without), rel=1e-9
        )
        turned = gap_range(*moved(view, turn), **error)
        assert turned[:3] == pytest.approx(still[:3], rel=0.03)


def test_scale_scales_lengths_only():
    rng = np.random.default_rng(5)
    for factor in (1e-3, 1000.0):
        view, error = scene(rng), errors(rng)
        small = gap_range(*view[:4], **error)
        error["translation_error"] *= factor
        large = gap_range(*moved(view, factor=factor), **error)
        assert large[:3] == pytest.approx(factor * np.array(small[:3]), rel=1e-9)
        assert large.snr == pytest.approx(small.snr, rel=1e-9)


def test_swapping_the_points_changes_nothing():
    rng = np.random.default_rng(6)
    for apex in ("first", "second", "best"):
        lens_0, lens_1, bearings_0, bearings_1, _ = scene(rng)
        error = errors(rng)
        straight = gap_range(lens_0, lens_1, bearings_0, bearings_1, **error, apex=apex)
        swapped = gap_range(lens_0, lens_1, bearings_0[::-1], bearings_1[::-1], **error, apex=apex)
        assert swapped == pytest.approx(straight, rel=1e-12)


def test_swapping_the_views_exchanges_the_apexes():
    rng = np.random.default_rng(7)
    for _ in range(10):
        lens_0, lens_1, bearings_0, bearings_1, _ = scene(rng)
        error = errors(rng)
        for apex, other in (("first", "second"), ("second", "first"), ("best", "best")):
            straight = gap_range(lens_0, lens_1, bearings_0, bearings_1, **error, apex=apex)
            swapped = gap_range(lens_1, lens_0, bearings_1, bearings_0, **error, apex=other)
            assert swapped == pytest.approx(straight, rel=1e-12)


def test_best_is_one_of_the_two_and_not_the_worse():
    rng = np.random.default_rng(8)
    for _ in range(20):
        *view, _ = scene(rng)
        error = errors(rng)
        first, second, best = (gap_range(*view, **error, apex=apex) for apex in ("first", "second", "best"))
        assert best in (first, second)
        assert best.snr == max(first.snr, second.snr)


@pytest.mark.parametrize("interval", ["paper", "worst_case"])
def test_greater_errors_never_narrow_the_range(interval):
    rng = np.random.default_rng(9)
    for _ in range(20):
        *view, _ = scene(rng)
        error = errors(rng)
        narrow = gap_range(*view, **error, interval=interval)
        for name in error:
            wide = gap_range(*view, **error | {name: 1.3 * error[name]}, interval=interval)
            assert wide.gap_min <= narrow.gap_min
            assert wide.gap_max >= narrow.gap_max
            assert wide.snr <= narrow.snr


def test_worst_case_holds_the_paper_s_range():
    rng = np.random.default_rng(10)
    for _ in range(20):
        *view, _ = scene(rng)
        error = errors(rng)
        paper, worst = (gap_range(*view, **error, interval=name) for name in ("paper", "worst_case"))
        assert worst.gap_min < paper.gap_min < paper.gap_max < worst.gap_max


def test_worst_case_holds_the_truth_of_bounded_errors():
    """Errors drawn within their bounds on the measured views: the gap of the true points is inside."""
    rng = np.random.default_rng(11)
    for _ in range(300):
        lens_0, lens_1, bearings_0, bearings_1, points = scene(rng, travel=6e-3, depth=10e-3)
        shaken = [
            unit(b + math.radians(0.5) * rng.uniform(-0.5, 0.5, (2, 3))) for b in (bearings_0, bearings_1)
        ]
        drift = rng.uniform(-1e-5, 1e-5, (2, 3))
        found = gap_range(
            lens_0 + drift[0],
            lens_1 + drift[1],
            *shaken,
            angular_error=math.radians(0.5),
            translation_error=2e-5,
        )
        assert found.gap_min <= np.linalg.norm(points[1] - points[0]) <= found.gap_max


def test_no_error_at_all():
    *view, points = scene(np.random.default_rng(12))
    found = gap_range(*view, angular_error=0.0, translation_error=0.0, apex="best")
    gap = np.linalg.norm(points[1] - points[0])
    assert found == pytest.approx((gap, gap, gap, math.inf))


@pytest.mark.parametrize("absent", ["angular_error", "translation_error"])
def test_one_kind_of_error_alone(absent):
    rng = np.random.default_rng(13)
    *view, _ = scene(rng)
    error = {"angular_error": PSI / 4, "translation_error": DT}
    both = gap_range(*view, **error)
    one = gap_range(*view, **error | {absent: 0.0})
    assert both.gap_min < one.gap_min < one.gap < one.gap_max < both.gap_max


def test_after_the_warm_up_nothing_is_compiled_any_more():
    """Not for views, read-only arrays or lists, other intervals, apexes or radii: an image must not wait."""
    warm_up()
    compiled = len(cloud_range.signatures)
    lens_0, lens_1, bearings_0, bearings_1, _ = scene(np.random.default_rng(14))
    bearings_0.setflags(write=False)
    for interval, apex, radii in product(("paper", "worst_case"), ("first", "second", "best"), (1, 2)):
        gap_range(
            list(lens_0), lens_1, bearings_0[::-1], bearings_1.T.copy().T[::-1],
            angular_error=0.01, translation_error=1e-5, interval=interval, apex=apex, radii=radii,
        )  # fmt: skip
    assert len(cloud_range.signatures) == compiled == 1


def test_inputs_are_left_as_they_were():
    view = scene(np.random.default_rng(15))[:4]
    before = [array.copy() for array in view]
    gap_range(*view, angular_error=0.01, translation_error=1e-5, apex="best")
    for array, copy in zip(view, before, strict=True):
        np.testing.assert_array_equal(array, copy)
