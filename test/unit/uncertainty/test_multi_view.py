"""The fit over all views: its likelihood, its laws, its covariance against what is simulated, its gate."""

import numpy as np
import pytest
from path_views import (
    DEVIATION,
    LENS_RMS,
    POINTS,
    Floats,
    directions,
    lens_path,
    noisy,
    views_of,
)
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from knee_gap_uncertainty.multi_view.likelihood import Measured, blank, linearise, mean_frames
from knee_gap_uncertainty.multi_view.maximum_likelihood import fit, points_jacobian, points_of
from knee_gap_uncertainty.multi_view.views import Views, isotropic_covariances


@pytest.mark.parametrize("count", [2, 3, 10, 240, 1000])
def test_exact_views_give_the_exact_points(count: int) -> None:
    lens = lens_path(count)
    exact = np.full((count, 3, 3), 0.0)
    fitted = fit(
        views_of(lens, directions(lens), lens_covariances=exact, rotation_covariances=exact, deviation=1e-4)
    )
    np.testing.assert_allclose(fitted.points, POINTS, atol=1e-9)
    assert fitted.gap == pytest.approx(np.linalg.norm(POINTS[1] - POINTS[0]), abs=1e-9)
    assert fitted.used.all()


def test_residual_jacobians_are_the_finite_differences() -> None:
    """At the exact bearings; elsewhere the image axes turn with the residual, which the slopes leave out."""
    views = views_of(lens_path(4), directions(lens_path(4)))
    frames, centre = mean_frames(views.bearings), views.lens_positions.mean(axis=0)
    unknowns = fit(
        views_of(views.lens_positions, views.bearings, lens_covariances=np.zeros((4, 3, 3)))
    ).unknowns

    def linearised(unknowns: Floats, lens: Floats) -> tuple[Floats, Floats, Floats]:
        measured = Measured(
            lens,
            views.bearings,
            views.bearing_covariances,
            views.lens_covariances,
            views.rotation_covariances,
            views.lens_axes,
            centre,
            frames,
        )
        out = blank(len(views))
        linearise(measured, np.ones((4, 2), dtype=np.bool_), unknowns.reshape(2, 3), out)
        return out.residuals, out.jacobians, out.lens_jacobians

    _, jacobians, lens_jacobians = linearised(unknowns, views.lens_positions)
    for row in range(4):
        n, axis = divmod(row, 2)
        numeric = approx_fprime(
            unknowns.ravel(),
            lambda values, row=row: linearised(values, views.lens_positions)[0][2, row],
            1e-6 * np.array([1, 1, 100, 1, 1, 100]),
        )
        np.testing.assert_allclose(-numeric[3 * n : 3 * n + 3], jacobians[2, n, axis], rtol=1e-4, atol=1e-6)

        def of_lens(position: Floats, row: int = row) -> float:
            lens = views.lens_positions.copy()
            lens[2] = position
            return float(linearised(unknowns, lens)[0][2, row])

        numeric = approx_fprime(views.lens_positions[2], of_lens, 1e-8)
        np.testing.assert_allclose(
            -numeric / unknowns[n, 2], lens_jacobians[2, n, axis], rtol=1e-4, atol=1e-4
        )


def test_jacobian_of_the_points_is_the_finite_difference() -> None:
    frames = mean_frames(directions(lens_path(5)))
    unknowns = np.array([[0.01, -0.02, 95.0], [-0.015, 0.005, 88.0]])
    numeric = np.stack(
        [
            approx_fprime(
                unknowns.ravel(),
                lambda values, k=k: points_of(np.zeros(3), frames, values.reshape(2, 3)).ravel()[k],
                1e-6 * np.array([1, 1, 100, 1, 1, 100]),
            )
            for k in range(6)
        ]
    )
    np.testing.assert_allclose(points_jacobian(frames, unknowns), numeric, rtol=1e-4, atol=1e-8)


def test_a_rigid_motion_moves_the_points_and_nothing_else() -> None:
    views = noisy(np.random.default_rng(5), 20, share=0.5)
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.3, -0.2, 1.0])
    moved = fit(
        Views(
            views.lens_positions @ turn.T + shift,
            views.bearings @ turn.T,
            turn @ views.bearing_covariances @ turn.T,
            turn @ views.lens_covariances @ turn.T,
            turn @ views.rotation_covariances @ turn.T,
            views.common_share,
        )
    )
    fitted = fit(views)
    np.testing.assert_allclose(moved.points, fitted.points @ turn.T + shift, atol=1e-8)
    assert moved.gap == pytest.approx(fitted.gap, abs=1e-8)
    assert moved.gap_deviation == pytest.approx(fitted.gap_deviation, rel=1e-2)


def test_order_of_views_and_of_points_and_scale_do_not_matter() -> None:
    views = noisy(np.random.default_rng(6), 20, share=0.5)
    fitted = fit(views)
    order = np.random.default_rng(0).permutation(20)
    shuffled = views_of(views.lens_positions[order], views.bearings[order], share=0.5)
    assert fit(shuffled).gap == pytest.approx(fitted.gap, rel=1e-6)
    swapped = fit(views_of(views.lens_positions, views.bearings[:, ::-1], share=0.5))
    np.testing.assert_allclose(swapped.points[::-1], fitted.points, rtol=1e-6, atol=1e-9)
    larger = fit(
        views_of(
            10.0 * views.lens_positions,
            views.bearings,
            share=0.5,
            lens_covariances=100.0 * views.lens_covariances,
        )
    )
    assert larger.gap == pytest.approx(10.0 * fitted.gap, rel=1e-6)
    assert larger.gap_deviation == pytest.approx(10.0 * fitted.gap_deviation, rel=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("count", [2, 20])
def test_covariance_is_that_of_simulated_estimates(count: int, share: float) -> None:
    rng = np.random.default_rng(count)
    runs = 800
    fits = [fit(noisy(rng, count, share=share)) for _ in range(runs)]
    gaps = np.array([fitted.gap for fitted in fits])
    stated = np.median([fitted.gap_deviation for fitted in fits])
    # The deviation of a sample of this size, at 1 in 10^4, and the curvature of the distance.
    margin = 4.0 / np.sqrt(2.0 * runs) + 0.03
    assert gaps.std() == pytest.approx(stated, rel=margin)
    truth = np.linalg.norm(POINTS[1] - POINTS[0])
    assert abs(gaps.mean() - truth) < 4.0 * stated / np.sqrt(runs) + 0.15 * stated
    offsets = np.array([fitted.points - POINTS for fitted in fits]).reshape(runs, 6)
    mahalanobis = np.median(
        [
            offset @ np.linalg.solve(fitted.covariance, offset)
            for offset, fitted in zip(offsets, fits, strict=True)
        ]
    )
    assert mahalanobis == pytest.approx(chi2(6).ppf(0.5), rel=0.12)


def test_noisy_lens_positions_do_not_bring_the_points_nearer() -> None:
    """Many views of a short travel: lens errors, in the slopes too, would pull the depth by a deviation."""
    rng = np.random.default_rng(9)
    lens, runs = lens_path(240, travel=0.001), 150
    depth = []
    for _ in range(runs):
        measured = lens + rng.standard_normal(lens.shape) * LENS_RMS / np.sqrt(3.0)
        bearings = directions(lens) + 0.003 * rng.standard_normal((240, 2, 3))
        bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
        depth.append(fit(views_of(measured, bearings, deviation=0.003)).unknowns[0, 2])
    truth = 1.0 / np.linalg.norm(POINTS[0])
    assert np.mean(depth) == pytest.approx(truth, rel=4.0 * np.std(depth) / truth / np.sqrt(runs) + 0.002)


def test_common_part_does_not_average_out() -> None:
    rng = np.random.default_rng(11)
    few, many = (fit(noisy(rng, count, share=0.5)) for count in (10, 240))
    assert many.gap_deviation > 0.5 * few.gap_deviation
    few, many = (fit(noisy(rng, count, share=0.0)) for count in (10, 240))
    assert many.gap_deviation < 0.35 * few.gap_deviation


@pytest.mark.parametrize(
    ("changed", "largest"),
    [("image", 0), ("lens", 1), ("rotation", 2), ("common", 3)],
)
def test_shares_sum_to_one_and_follow_the_cause(changed: str, largest: int) -> None:
    lens = lens_path(12)
    bearings = directions(lens)
    fitted = fit(
        views_of(
            lens,
            bearings,
            deviation=0.02 if changed in ("image", "common") else 1e-4,
            share=0.9 if changed == "common" else 0.1,
            lens_covariances=isotropic_covariances(12, 2e-4 if changed == "lens" else 1e-7),
            rotation_covariances=isotropic_covariances(12, 1e-3 if changed == "rotation" else 1e-6),
        )
    )
    assert fitted.shares.sum() == pytest.approx(1.0)
    assert np.argmax(fitted.shares) == largest
    assert fitted.shares[largest] > 0.7


def test_shares_are_the_variance_that_goes_with_their_cause() -> None:
    lens = lens_path(12)
    bearings = directions(lens)
    whole = fit(views_of(lens, bearings, share=0.4))
    without = fit(views_of(lens, bearings, share=0.4, lens_covariances=np.zeros((12, 3, 3))))
    lost = 1.0 - without.gap_deviation**2 / whole.gap_deviation**2
    assert lost == pytest.approx(whole.shares[1], abs=0.01)


def spoiled(views: Views, view: int, point: int, deviations: float, rng: np.random.Generator) -> Views:
    """The views with one bearing moved by so many standard deviations, whichever way."""
    bearings = views.bearings.copy()
    bearing = bearings[view, point]
    side = np.cross(bearing, rng.standard_normal(3))
    bearing = bearing + np.tan(deviations * DEVIATION) * side / np.linalg.norm(side)
    bearings[view, point] = bearing / np.linalg.norm(bearing)
    return views_of(views.lens_positions, bearings, share=views.common_share)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_one_bad_bearing_among_thirty_hardly_moves_the_gap(share: float) -> None:
    rng = np.random.default_rng(21)
    runs, moved = 800, 0
    for _ in range(runs):
        views = noisy(rng, 30, share=share)
        clean = fit(views)
        bad = fit(spoiled(views, int(rng.integers(30)), int(rng.integers(2)), 5.0, rng))
        moved += abs(bad.gap - clean.gap) > 0.25 * 2 * 1.96 * clean.gap_deviation
    # 1 % and three deviations of such a count.
    assert moved <= 0.01 * runs + 3.0 * np.sqrt(0.01 * runs)


def test_a_gross_error_is_gated_and_only_that() -> None:
    rng = np.random.default_rng(22)
    views = noisy(rng, 30, share=0.0)
    fitted = fit(spoiled(views, 7, 1, 12.0, rng))
    assert not fitted.used[7, 1]
    assert np.isnan(fitted.residuals[7, 1])
    assert (~fitted.used).sum() <= 2


def test_errors_larger_than_stated_widen_the_covariance_from_ten_views_on() -> None:
    rng = np.random.default_rng(23)
    small = noisy(rng, 40, deviation=2 * DEVIATION)
    reported = views_of(small.lens_positions, small.bearings, deviation=DEVIATION)
    assert fit(reported).scale == pytest.approx(4.0, rel=0.4)
    assert fit(noisy(rng, 40)).scale < 1.3
    two = noisy(rng, 2, deviation=5 * DEVIATION)
    assert fit(views_of(two.lens_positions, two.bearings)).scale == 1.0
