"""Lens and body-to-lens from synthetic views: truth, coverage of the stated uncertainty, and refusals."""

from collections.abc import Sequence

import numpy as np
import pytest

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import angle_between, apply, from_vector, inverse, to_vector
from knee_gap_perception.calibrate.measurements.boards import CORNER_BIAS_PX, BoardView
from knee_gap_perception.calibrate.solvers.hand_eye import HandEye, HandEyeSettings, calibrate_hand_eye
from knee_gap_perception.calibrate.solvers.hand_eye_bundle import HandEyeBundle, HandEyeState, TrackedView
from knee_gap_perception.calibrate.solvers.intrinsics import (
    IntrinsicsFit,
    board_pose,
    design_effect,
    fit_intrinsics,
)
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis, rotated_lens

SIZE = (1280, 720)
LENS = np.array([452.0, 453.0, 645.0, 357.0, 0.02, -0.01, 0.0, 0.0])
MODEL = LensModel("equidistant")
T_BODY_LENS = from_vector([0.5, -0.03, -0.06, 0.0035, -0.012, 0.2])
T_WORLD_BOARD = from_vector([0.4, -0.9, 0.3, 0.2, 1.0, -0.1])
AXIS = ShaftAxis(
    np.array([0.05, -0.04, 1.0]) / np.linalg.norm([0.05, -0.04, 1.0]), np.array([0.0035, -0.012, 0.1])
)
GRID = np.stack(
    [*np.meshgrid(np.arange(11) * 0.003, np.arange(8) * 0.003), np.zeros((8, 11))], axis=-1
).reshape(-1, 3)
SIGMA_PX = 0.1
TURN_ERROR, SHIFT_ERROR = np.radians(0.004), 0.0367e-3


def views(seed: int, turns: Sequence[float], tilt: float = 0.45, noise: float = 1.0) -> list[TrackedView]:
    rng = np.random.default_rng(seed)
    tracked = []
    for i, turn in enumerate(turns):
        swing = rng.uniform(-1, 1, 6) * [tilt, tilt, 0.7, 0.006, 0.005, 0.006]
        T_board_lens = (
            from_vector([0, 0, 0, 0.0165 + swing[3], 0.012 + swing[4], 0])
            @ from_vector([swing[0], swing[1], 0, 0, 0, 0])
            @ from_vector([0, 0, swing[2], 0, 0, -0.024 + swing[5]])
        )
        projected = MODEL.project(apply(inverse(T_board_lens), GRID), LENS).pixels
        pixels = projected + noise * SIGMA_PX * rng.standard_normal(projected.shape)
        seen = np.linalg.norm(projected - LENS[2:4], axis=1) < 350
        error = np.concatenate([TURN_ERROR * rng.standard_normal(3), SHIFT_ERROR * rng.standard_normal(3)])
        T_world_body = (
            T_WORLD_BOARD @ T_board_lens @ inverse(rotated_lens(T_BODY_LENS, turn, Mount.CAMERA_HEAD, AXIS))
        )
        board = BoardView(i, np.flatnonzero(seen), GRID[seen], pixels[seen])
        tracked.append(
            TrackedView(board, T_world_body @ from_vector(noise * error / np.sqrt(3)), np.zeros(6), turn)
        )
    return tracked


def fitted(tracked: Sequence[TrackedView]) -> IntrinsicsFit:
    return fit_intrinsics([view.board for view in tracked], *SIZE, MODEL)


def calibrated(tracked: Sequence[TrackedView], settings: HandEyeSettings | None = None) -> HandEye:
    return calibrate_hand_eye(tracked, fitted(tracked).intrinsics, MODEL, settings)


def lens_error(found: HandEye) -> Array:
    return to_vector(inverse(found.T_body_lens) @ T_BODY_LENS)


def test_intrinsics_are_found_without_a_guess() -> None:
    fit = fitted(views(1, np.zeros(20)))
    assert fit.intrinsics.sigma_px == pytest.approx(SIGMA_PX, rel=0.1)
    error = fit.intrinsics.parameters - LENS
    sigma = np.sqrt(np.diag(fit.intrinsics.covariance))
    assert (np.abs(error[MODEL.free]) < 4 * sigma[MODEL.free]).all()
    assert (sigma[~MODEL.free] == 0).all()


def test_a_pinhole_lens_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    model = LensModel("plumb_bob")
    lens = np.array([900.0, 910.0, 640.0, 350.0, -0.2, 0.05, 0.001, -0.002, 0.0])
    rng = np.random.default_rng(3)
    seen = []
    for i in range(8):
        pose = from_vector(
            rng.uniform(-1, 1, 6) * [0.5, 0.5, 1.0, 0.004, 0.004, 0.01] + [0, 0, 0, -0.0165, -0.012, 0.06]
        )
        pixels = model.project(apply(pose, GRID), lens).pixels + 0.1 * rng.standard_normal((len(GRID), 2))
        seen.append(BoardView(i, np.arange(len(GRID)), GRID, pixels))
    ours = fit_intrinsics(seen, *SIZE, model).intrinsics.parameters
    theirs = cv2.calibrateCamera(
        [view.points.astype(np.float32) for view in seen],
        [view.pixels.astype(np.float32) for view in seen],
        SIZE, None, None, flags=cv2.CALIB_FIX_K3,
    )  # fmt: skip
    assert ours[:4] == pytest.approx(
        [theirs[1][0, 0], theirs[1][1, 1], theirs[1][0, 2], theirs[1][1, 2]], abs=0.01
    )
    assert ours[4:8] == pytest.approx(theirs[2].ravel()[:4], abs=1e-4)


def test_outliers_are_left_out() -> None:
    tracked = views(4, np.zeros(12))
    tracked[3].board.pixels[5] += 8.0
    tracked[7].board.pixels[9] -= 5.0
    fit = fitted(tracked)
    assert fit.outlier_count >= 2
    assert fit.intrinsics.parameters[:4] == pytest.approx(LENS[:4], abs=1.0)


def test_neighbours_that_err_alike_count_as_fewer_points() -> None:
    rng = np.random.default_rng(5)
    seen = [view.board for view in views(5, np.zeros(6))]
    independent = [rng.standard_normal(view.pixels.shape) for view in seen]
    assert design_effect(seen, independent) == pytest.approx(1.0, abs=0.15)
    wavy = [
        np.column_stack([np.sin(view.points[:, 0] * 300), np.cos(view.points[:, 1] * 300)]) for view in seen
    ]
    assert design_effect(seen, wavy) > 3


def test_derivatives_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(6)
    tracked = [
        view._replace(twist_rate=rng.uniform(-0.3, 0.3, 6), turn_sigma=0.01)
        for view in views(6, [0.0, 0.4, -0.5, 0.2])
    ]
    bundle = HandEyeBundle(tuple(tracked), MODEL, True, True, Mount.CAMERA_HEAD, 0.1, np.full(6, 1e-3))
    state = HandEyeState(T_BODY_LENS, T_WORLD_BOARD, LENS, 0.0, AXIS, np.zeros((4, 7)))
    linear = bundle.linear(1, state)
    step = 1e-6
    for column in range(linear.by_shared.shape[1]):
        change = np.zeros(linear.by_shared.shape[1])
        change[column] = step
        ahead, behind = (
            bundle.linear(1, bundle.moved(state, sign * change, [np.zeros(7)] * 4)).residual
            for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        assert linear.by_shared[:, column] == pytest.approx(
            expected, rel=1e-4, abs=1e-4 * np.abs(expected).max()
        )
    for column in range(7):
        change = np.zeros(7)
        change[column] = step
        still = np.zeros(linear.by_shared.shape[1])
        ahead, behind = (
            bundle.linear(1, bundle.moved(state, still, [sign * change] * 4)).residual for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        assert linear.by_error[:, column] == pytest.approx(
            expected, rel=1e-4, abs=1e-4 * np.abs(expected).max()
        )


def test_perfect_views_give_the_truth() -> None:
    found = calibrated(views(7, np.zeros(12), noise=1e-3))
    error = lens_error(found)
    assert np.linalg.norm(error[3:]) < 1e-6
    assert np.linalg.norm(error[:3]) < 1e-5


@pytest.mark.parametrize("free", [True, False])
def test_the_stated_uncertainty_covers_the_truth(free: bool) -> None:
    distances = []
    for seed in range(8):
        found = calibrated(views(100 + seed, np.zeros(16)), HandEyeSettings(free_intrinsics=free))
        error = lens_error(found)
        assert np.linalg.norm(error[3:]) < 0.2e-3
        assert np.linalg.norm(error[:3]) < np.radians(0.2)
        distances.append(error @ np.linalg.solve(found.covariance, error))
    # Chi-square of 6 x 8 degrees of freedom would lie in 31-69 (95 %); the floor for bias makes it smaller.
    assert 3 < np.sum(distances) < 75
    assert max(distances) < 22.5  # 99.9 % of 6 degrees of freedom


def test_a_worse_tracker_is_noticed() -> None:
    good, bad = views(8, np.zeros(30)), views(8, np.zeros(30))
    rng = np.random.default_rng(8)
    bad = [
        view._replace(
            T_world_body=view.T_world_body @ from_vector(np.repeat([1e-3, 3e-4], 3) * rng.standard_normal(6))
        )
        for view in bad
    ]
    found, worse = calibrated(good), calibrated(bad)
    assert worse.translation_error == pytest.approx(3e-4 * np.sqrt(3), rel=0.35)
    assert worse.rotation_error == pytest.approx(1e-3 * np.sqrt(3), rel=0.35)
    assert worse.translation_error > 4 * found.translation_error
    assert np.trace(worse.covariance) > 4 * np.trace(found.covariance)


def test_a_turned_scope_and_its_axis_are_found() -> None:
    turns = np.concatenate([np.zeros(12), np.random.default_rng(9).uniform(-0.9, 0.9, 16)])
    found = calibrated(views(9, turns))
    assert found.axis is not None
    assert np.arccos(found.axis.direction @ AXIS.direction) < np.radians(0.05)
    for turn in (-0.7, 0.0, 0.8):
        truth = rotated_lens(T_BODY_LENS, turn, Mount.CAMERA_HEAD, AXIS)
        lens = rotated_lens(found.T_body_lens, turn, Mount.CAMERA_HEAD, found.axis)
        assert np.linalg.norm(lens[:3, 3] - truth[:3, 3]) < 0.1e-3
        assert angle_between(lens, truth) < np.radians(0.1)


def test_a_wrong_clock_is_found_where_the_body_moves() -> None:
    rng = np.random.default_rng(10)
    moving, offset = [], 0.004
    for view in views(10, np.zeros(24)):
        rate = rng.uniform(-1, 1, 6) * [0.5, 0.5, 0.5, 0.04, 0.04, 0.04]
        late = view.T_world_body @ inverse(from_vector(offset * rate))
        moving.append(view._replace(T_world_body=late, twist_rate=rate))
    found = calibrated(moving)
    assert abs(found.time_offset - offset) < 4 * found.time_offset_sigma
    assert found.time_offset_sigma < 1e-3


def test_leaving_out_a_view_shows_one_that_does_not_fit() -> None:
    tracked = views(11, np.zeros(14))
    tracked[5] = tracked[5]._replace(
        T_world_body=tracked[5].T_world_body @ from_vector([0, 0.01, 0, 0, 0, 0])
    )
    found = calibrated(tracked)
    assert int(found.left_out_rms_px.argmax()) == 5
    assert found.left_out_rms_px[5] > 3 * np.median(found.left_out_rms_px)


def test_views_all_from_one_side_are_refused() -> None:
    with pytest.raises(PerceptionError, match="same side"):
        fitted(views(12, np.zeros(12), tilt=0.02))


def test_too_few_views_are_refused() -> None:
    with pytest.raises(PerceptionError, match="4 are needed"):
        fitted(views(13, np.zeros(3)))


def test_turning_about_one_axis_only_is_refused() -> None:
    good = views(14, np.zeros(12))
    first = good[0].T_world_body
    same = [
        view._replace(T_world_body=first @ from_vector([0, 0, 0.1 * i, 0, 0, 0]))
        for i, view in enumerate(good)
    ]
    with pytest.raises(PerceptionError, match="about a second"):
        calibrated(same)


def test_a_small_turn_of_the_scope_cannot_give_its_axis() -> None:
    turns = np.concatenate([np.zeros(8), np.full(8, 0.15)])
    with pytest.raises(PerceptionError, match="turn the light post further"):
        calibrated(views(15, turns))


def test_a_board_whose_origin_lies_behind_the_lens_has_a_pose() -> None:
    """The corner of a board that is looked at slantwise from near need not be before the lens."""
    T_lens_board = from_vector([0.5746, -0.3149, 0.5496, -0.00874, -0.022, -0.0004])
    before = apply(T_lens_board, GRID)[:, 2] > 0.008
    points = GRID[before]
    view = BoardView(
        0, np.flatnonzero(before), points, MODEL.project(apply(T_lens_board, points), LENS).pixels
    )
    assert board_pose(view, LENS, MODEL) == pytest.approx(T_lens_board, abs=1e-5)


def test_what_corners_have_in_common_is_less_than_what_dots_have() -> None:
    """The bias that no residual shows depends on what was found, and is in every covariance."""
    tracked = views(3, np.zeros(20))
    corners = [one._replace(board=one.board._replace(bias_px=CORNER_BIAS_PX)) for one in tracked]
    by_dots, by_corners = calibrated(tracked), calibrated(corners)
    assert (np.diag(by_dots.covariance) > np.diag(by_corners.covariance)).all()
    assert by_dots.intrinsics.covariance[0, 0] > by_corners.intrinsics.covariance[0, 0]
