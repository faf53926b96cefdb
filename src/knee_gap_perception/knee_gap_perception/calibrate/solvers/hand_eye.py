"""Hand-eye calibration: the pose of the lens on the tracked body, with its covariance.

The initial state comes from OpenCV's closed-form solvers: the five of `calibrateHandEye` and the two of
`calibrateRobotWorldHandEye`. The best of them is refined by least squares on the reprojected board points of
all views,

    pixel = project(T_lens_body exp(-e) T_body_world T_world_board point),

with a pose error e of the tracker in each view, weighted by its variance. That variance is estimated jointly
by restricted maximum likelihood, so that the covariance of the result is based on the data, not on the
tracker's data sheet.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import apply, from_vector, inverse, mean
from knee_gap_perception.calibrate.solvers.bundle import Block, minimise
from knee_gap_perception.calibrate.solvers.hand_eye_bundle import (
    SAME_TURN,
    HandEyeBundle,
    HandEyeState,
    LinearView,
    TrackedView,
    tracker_sigma,
)
from knee_gap_perception.calibrate.solvers.intrinsics import bias_of, board_pose, systematic
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis, roll

MIN_VIEWS = 4
MIN_TURN = np.radians(5.0)  # least RMS rotation of the views about a second axis
MIN_SCOPE_ROTATION = np.radians(20.0)  # least range of scope rotations to estimate the shaft's axis

# Table 3 of the paper, set 1: the ratio of the tracker's two errors; their size is estimated.
TRANSLATION_ERROR = 0.0367e-3
ROTATION_ERROR = np.radians(0.004)
START_SCALE = 5.0
OUTLYING_TIMES, OUTLYING_PX = 6.0, 2.0  # a view above both is left out: multiples of the median, and pixels
OUTLYING_VIEWS = 12
# Effect on the lens of a bias of the points that is common to all views, as fractions of the angle of the
# bias at the border of the image (x, y, z): rotations, and shifts by angle x distance. The largest effect is
# on the distance.
BIAS_TURNS, BIAS_SHIFTS = (0.5, 0.5, 0.25), (0.5, 0.5, 2.0)
# Errors of the clock: by the smoothing of a hand's tremor [s], and by the bias of the points [s/px].
ERROR_OF_SMOOTHING, TIME_BY_BIAS = 3e-5, 4e-4


class SolverResult(NamedTuple):
    """Result of one closed-form solver, and its RMS reprojection error [px]."""

    name: str
    T_body_lens: Array
    rms_px: float


@dataclass(frozen=True)
class HandEyeSettings:
    """Options: what is estimated besides the two poses, and the tracker's prior error (RMS [m], [rad])."""

    free_intrinsics: bool = True
    free_time_offset: bool = True
    mount: Mount = Mount.CAMERA_HEAD
    translation_error: float = TRANSLATION_ERROR
    rotation_error: float = ROTATION_ERROR


@dataclass(frozen=True)
class HandEye:
    """The pose of the lens on its body.

    `covariance` (6, 6) is that of the twist (rotation, translation) of T_body_lens in the lens frame: the
    error common to all views. `time_offset` [s] is to be added to an image's stamp, in addition to the offset
    already applied, to get the tracker's time. `rotation_error` [rad] and `translation_error` [m] are the
    tracker's errors of the body estimated from the views (RMS lengths).
    """

    T_body_lens: Array
    covariance: Array
    T_world_board: Array
    intrinsics: Intrinsics
    axis: ShaftAxis | None
    axis_sigma: tuple[float, float] | None
    time_offset: float
    time_offset_sigma: float
    rotation_error: float
    translation_error: float
    rms_px: float
    left_out_rms_px: Array
    chi_square_per_freedom: float
    solvers: tuple[SolverResult, ...]

    @property
    def outlying(self) -> npt.NDArray[np.bool_]:
        """Mask (n,) of views that do not fit the others: none among few, and at most a fifth of them."""
        rms = self.left_out_rms_px
        worst = rms > max(OUTLYING_TIMES * float(np.median(rms)), OUTLYING_PX)
        enough = len(rms) >= OUTLYING_VIEWS and worst.mean() <= 0.2
        return worst if enough else np.zeros(len(rms), dtype=bool)


def calibrate_hand_eye(
    views: Sequence[TrackedView],
    intrinsics: Intrinsics,
    model: LensModel,
    settings: HandEyeSettings | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> HandEye:
    """Calibrate the lens on its body from views of one stationary board.

    Raises PerceptionError with advice on the recording for too few views and too little rotation.
    """
    chosen = settings or HandEyeSettings()
    _check(views)
    solvers = closed_form(views, intrinsics, model)
    best = min(solvers, key=lambda solver: solver.rms_px)
    report(f"refining {best.name}, {best.rms_px:.2f} px")
    bundle = HandEyeBundle(
        tuple(views),
        model,
        free_lens=chosen.free_intrinsics,
        timed=chosen.free_time_offset and any(np.any(view.twist_rate) for view in views),
        mount=chosen.mount,
        sigma_px=intrinsics.sigma_px * float(np.sqrt(intrinsics.design_effect)),
        pose_sigma=np.repeat([chosen.rotation_error, chosen.translation_error], 3) / np.sqrt(3),
    )
    bundle, state = _refine(bundle, _first_state(bundle, intrinsics.parameters, best.T_body_lens))
    return _result(bundle, state, intrinsics, solvers)


def closed_form(
    views: Sequence[TrackedView], intrinsics: Intrinsics, model: LensModel
) -> tuple[SolverResult, ...]:
    """Results of OpenCV's solvers for the views at the most frequent rotation of the scope.

    Raises PerceptionError if none of them is finite.
    """
    alike, turn = _most_frequent(np.array([view.scope_rotation for view in views]))
    chosen = [views[i] for i in np.flatnonzero(alike)]
    if len(chosen) < MIN_VIEWS:
        raise PerceptionError(
            f"{len(chosen)} views share one rotation of the scope; at least {MIN_VIEWS} are needed: also "
            "keep the light post still for some time"
        )
    _check(chosen)
    body = np.array([view.T_world_body for view in chosen])
    board = np.array([board_pose(view.board, intrinsics.parameters, model) for view in chosen])
    results = []
    for name, T_body_lens in _opencv_solutions(body, board).items():
        if not np.isfinite(T_body_lens).all():
            continue
        T_world_board = mean(body @ T_body_lens @ board)
        lens_board = inverse(body @ T_body_lens) @ T_world_board
        errors = [
            model.project(apply(T, view.board.points), intrinsics.parameters).pixels - view.board.pixels
            for T, view in zip(lens_board, chosen, strict=True)
        ]
        rms = float(np.sqrt(2 * np.mean(np.concatenate(errors) ** 2)))
        # There is no axis yet, so the reference is the group's own rotation; the fit converts to rotation 0.
        results.append(SolverResult(name, T_body_lens @ roll(turn), rms))
    results = [result for result in results if np.isfinite(result.rms_px)]
    if not results:
        raise PerceptionError("no hand-eye solver gives a finite result: rotate the scope about several axes")
    return tuple(results)


def _opencv_solutions(body: Array, board: Array) -> dict[str, Array]:
    """`T_body_lens` by solver; those that fail are left out."""
    R_body, t_body = list(body[:, :3, :3]), list(body[:, :3, 3])
    R_board, t_board = list(board[:, :3, :3]), list(board[:, :3, 3])
    back = inverse(body)
    R_back, t_back = list(back[:, :3, :3]), list(back[:, :3, 3])
    solutions = {}
    for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        method = getattr(cv2, f"CALIB_HAND_EYE_{name}")
        with suppress(cv2.error):
            R, t = cv2.calibrateHandEye(R_body, t_body, R_board, t_board, method=method)
            solutions[name.lower()] = _joined(R, t)
    for name in ("SHAH", "LI"):
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}")
        with suppress(cv2.error):
            found = cv2.calibrateRobotWorldHandEye(R_board, t_board, R_back, t_back, method=method)
            solutions[f"robot_world_{name.lower()}"] = inverse(_joined(found[2], found[3]))
    return solutions


def _joined(R: Any, t: Any) -> Array:
    if not np.isfinite(R).all() or abs(np.linalg.det(R) - 1) > 1e-3:
        return np.full((4, 4), np.nan)
    return from_vector(np.concatenate([Rotation.from_matrix(R).as_rotvec(), np.ravel(t)]))


def _check(views: Sequence[TrackedView]) -> None:
    if len(views) < MIN_VIEWS:
        raise PerceptionError(
            f"the body was tracked and the board found in {len(views)} views; at least {MIN_VIEWS} are "
            "needed, 20 are good"
        )
    rotations = Rotation.from_matrix(np.array([view.T_world_body[:3, :3] for view in views]))
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    turn = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(views))
    if turn[1] < MIN_TURN:
        raise PerceptionError(
            f"the scope rotates by {np.degrees(turn[0]):.1f} deg (RMS) about one axis and "
            f"{np.degrees(turn[1]):.1f} deg about a second; at least {np.degrees(MIN_TURN):.0f} deg about "
            "both are needed: tilt it to the sides, up and down, and rotate it about its shaft"
        )


def _first_state(bundle: HandEyeBundle, lens: Array, T_body_lens: Array) -> HandEyeState:
    """Initial state: the closed-form pose at the most frequent rotation, and the axis from the others."""
    boards = np.array([board_pose(view.board, lens, bundle.model) for view in bundle.views])
    bodies = np.array([view.T_world_body for view in bundle.views])
    turns = np.array([view.scope_rotation for view in bundle.views])
    alike, reference = _most_frequent(turns)
    T_world_board = mean((bodies @ T_body_lens @ roll(-reference) @ boards)[alike])
    axis, unturned = None, T_body_lens
    if bundle.has_axis:
        if np.ptp(turns) < MIN_SCOPE_ROTATION:
            raise PerceptionError(
                f"the scope rotates by {np.degrees(np.ptp(turns)):.1f} deg in its camera head; the shaft's "
                f"axis needs at least {np.degrees(MIN_SCOPE_ROTATION):.0f} deg: turn the light post further, "
                "or not at all"
            )
        lenses = inverse(bodies) @ T_world_board @ inverse(boards)
        axis = _first_axis(lenses, T_body_lens @ roll(-reference), turns - reference)
        unturned = axis.turned(-reference) @ T_body_lens
    return HandEyeState(unturned, T_world_board, lens, 0.0, axis, np.zeros((len(turns), 7)))


def _most_frequent(turns: Array) -> tuple[npt.NDArray[np.bool_], float]:
    """Mask of the views at the most frequent rotation, and that rotation [rad]."""
    alike = np.abs(turns[:, None] - turns[None]) < SAME_TURN
    chosen = alike[alike.sum(axis=1).argmax()]
    return chosen, float(np.median(turns[chosen]))


def _first_axis(lenses: Array, lens_at_reference: Array, turns: Array) -> ShaftAxis:
    """Axis of the rotations S = T_body_lens(turn) Rz(turn) T_body_lens(0)^-1, weighted by their angles."""
    unrolled = np.array([T @ roll(turn) for T, turn in zip(lenses, turns, strict=True)])
    moved = unrolled @ inverse(lens_at_reference)
    direction = turns @ Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    direction = direction / np.linalg.norm(direction)
    stacked = np.eye(3) - moved[:, :3, :3]
    point = np.linalg.lstsq(
        np.concatenate([stacked.reshape(-1, 3), direction[None]]),
        np.concatenate([moved[:, :3, 3].ravel(), [direction @ lens_at_reference[:3, 3]]]),
        rcond=None,
    )[0]
    return ShaftAxis(direction, point)


def _refine(bundle: HandEyeBundle, state: HandEyeState) -> tuple[HandEyeBundle, HandEyeState]:
    """Minimise and re-estimate the tracker's error alternately until it converges, from a large one."""
    presumed = bundle.pose_sigma
    bundle = replace(bundle, pose_sigma=START_SCALE * presumed)
    for _ in range(8):
        state = minimise(bundle, state)
        sigma = tracker_sigma(bundle, state, presumed)
        change = float(np.abs(np.log(sigma / bundle.pose_sigma)).max())
        bundle = replace(bundle, pose_sigma=sigma)
        if change < 0.02:
            break
    return bundle, minimise(bundle, state)


def _result(
    bundle: HandEyeBundle, state: HandEyeState, intrinsics: Intrinsics, solvers: tuple[SolverResult, ...]
) -> HandEye:
    blocks = bundle.blocks(state)
    reduced = [b.reduced() for b in blocks]
    information = np.sum([part[0] for part in reduced], axis=0)
    linear = [bundle.linear(i, state) for i in range(len(bundle.views))]
    independent = sum(len(x.residual) for x in linear) / intrinsics.design_effect
    chi_square = bundle.cost(state) / max(1.0, independent - len(information))
    covariance = max(1.0, chi_square) * np.linalg.inv(information)
    if not bundle.free_lens:
        covariance = covariance + _considered(bundle, linear, blocks, information, intrinsics.covariance)
    sigma, floor = np.sqrt(np.diag(covariance)), _systematic(bundle, state)
    squares = (
        np.concatenate([x.residual + x.by_error @ -e for x, e in zip(linear, state.errors, strict=True)]) ** 2
    )
    return HandEye(
        T_body_lens=state.T_body_lens,
        covariance=covariance[:6, :6] + floor,
        T_world_board=state.T_world_board,
        intrinsics=_refined_intrinsics(bundle, state, intrinsics, covariance),
        axis=state.axis,
        axis_sigma=_axis_sigma(sigma, floor) if bundle.has_axis else None,
        time_offset=state.time_offset,
        time_offset_sigma=_time_sigma(bundle, float(sigma[-5 if bundle.has_axis else -1])),
        rotation_error=float(bundle.pose_sigma[0] * np.sqrt(3)),
        translation_error=float(bundle.pose_sigma[3] * np.sqrt(3)),
        rms_px=float(np.sqrt(2 * squares.mean())),
        left_out_rms_px=_left_out(linear, state, reduced, information),
        chi_square_per_freedom=chi_square,
        solvers=solvers,
    )


def _systematic(bundle: HandEyeBundle, state: HandEyeState) -> Array:
    """Covariance (6, 6) by a bias of the detected points common to all views, which no residual shows."""
    poses = [board_pose(view.board, state.lens, bundle.model) for view in bundle.views]
    distance = float(np.median([np.linalg.norm(T_lens_board[:3, 3]) for T_lens_board in poses]))
    angle = bias_of([view.board for view in bundle.views]) / float(state.lens[0])
    return np.diag(np.square(np.concatenate([BIAS_TURNS, np.multiply(BIAS_SHIFTS, distance)]) * angle))


def _time_sigma(bundle: HandEyeBundle, fitted: float) -> float:
    """Standard error of the clock [s], by the fit and the bias of the points; NaN if not fitted."""
    if not bundle.timed:
        return np.nan
    by_bias = TIME_BY_BIAS * bias_of([view.board for view in bundle.views])
    return float(np.linalg.norm([fitted, ERROR_OF_SMOOTHING, by_bias]))


def _axis_sigma(sigma: Array, floor: Array) -> tuple[float, float]:
    """Standard deviations of the axis: tilt [rad] and shift [m], each the larger of two, with the floor."""
    tilt, shift = float(sigma[-4:-2].max()), float(sigma[-2:].max())
    return float(np.hypot(tilt, np.sqrt(floor[0, 0]))), float(np.hypot(shift, np.sqrt(floor[3, 3])))


def _considered(
    bundle: HandEyeBundle,
    linear: Sequence[LinearView],
    blocks: Sequence[Block],
    information: Array,
    lens: Array,
) -> Array:
    """Additional covariance by lens parameters that were not fitted."""
    shared = []
    for x, b in zip(linear, blocks, strict=True):
        by_lens = x.by_lens / bundle.sigma_px
        eliminated = np.linalg.solve(b.own, x.by_error.T @ by_lens / bundle.sigma_px)
        shared.append(x.by_shared.T @ by_lens / bundle.sigma_px - b.mixed @ eliminated)
    sensitivity = np.linalg.solve(information, np.sum(shared, axis=0))
    return np.asarray(sensitivity @ lens @ sensitivity.T)


def _refined_intrinsics(
    bundle: HandEyeBundle, state: HandEyeState, intrinsics: Intrinsics, covariance: Array
) -> Intrinsics:
    if not bundle.free_lens:
        return intrinsics
    free = bundle.model.free
    lens = np.zeros((len(free), len(free)))
    lens[np.ix_(free, free)] = covariance[12 : 12 + free.sum(), 12 : 12 + free.sum()]
    lens += systematic(len(free), bias_of([view.board for view in bundle.views]))
    fx, fy, cx, cy = (float(value) for value in state.lens[:4])
    k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    return replace(intrinsics, k=k, d=tuple(map(float, state.lens[4:])), covariance=lens)


def _left_out(
    linear: Sequence[LinearView],
    state: HandEyeState,
    reduced: Sequence[tuple[Array, Array]],
    information: Array,
) -> Array:
    """RMS [px] of each view as tracked (n,), with the fit to all other views; to first order."""
    rms = []
    for x, error, (own, gradient) in zip(linear, state.errors, reduced, strict=True):
        step = np.linalg.lstsq(information - own, gradient, rcond=None)[0]
        left = x.residual + x.by_shared @ step - x.by_error @ error
        rms.append(np.sqrt(2 * np.mean(left**2)))
    return np.array(rms)
