"""Calibration of the intrinsics: focal lengths, principal point and distortion with covariance, from a board.

It is Zhang's plane method as a bundle adjustment (Levenberg-Marquardt, the poses eliminated by a Schur
complement), started from the best of several focal lengths, so that the user does not have to guess one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import apply, from_vector, skew
from knee_gap_perception.calibrate.measurements.boards import MIN_POINTS, BoardView
from knee_gap_perception.calibrate.solvers.bundle import Block, block, minimise
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.projection import LensModel
from knee_gap_perception.errors import PerceptionError

MIN_VIEWS = 4
MIN_TILT = np.radians(
    15.0
)  # between the most different board normals; with less, focal length and depth cannot be separated
MIN_COVERAGE = 0.25  # least fraction of the image's height and width that the points span
OUTLIER_SIGMAS = 5.0
OUTLIER_FLOOR_PX = 0.3
CORRELATION_RANGE = 8  # spacings of the points over which their errors may be correlated


@dataclass(frozen=True)
class IntrinsicsFit:
    """The lens, the views it was fitted to without outliers, and T_lens_board of each."""

    intrinsics: Intrinsics
    views: tuple[BoardView, ...]
    T_lens_board: Array
    view_rms_px: Array
    outlier_count: int


def fit_intrinsics(
    views: Sequence[BoardView],
    width_px: int,
    height_px: int,
    model: LensModel,
    report: Callable[[str], None] = lambda _: None,
) -> IntrinsicsFit:
    """Fit a lens to views of one flat board.

    Raises PerceptionError with advice on the recording for too few views, views all from one side, and points
    in a small part of the image only.
    """
    usable = [view for view in views if len(view.ids) >= MIN_POINTS]
    _check_views(usable, len(views))
    parameters = _start(usable, width_px, height_px, model)
    # With the initial lens, a view at the border of the image may not have an initial pose.
    usable = [view for view in usable if tells_pose(view, parameters, model)]
    _check_views(usable, len(views))
    poses = np.array([board_pose(view, parameters, model) for view in usable])
    dropped = 0
    for _ in range(3):
        parameters, poses = minimise(_Bundle(usable, model), _State(parameters, poses))
        usable, poses, outliers = _without_outliers(usable, parameters, poses, model)
        dropped += outliers
        report(f"{len(usable)} views, {dropped} points dropped as outliers")
        if outliers == 0:
            break
        _check_views(usable, len(views))
    _check_geometry(usable, poses, width_px, height_px, parameters, model)
    return _result(usable, parameters, poses, model, (width_px, height_px), dropped)


def tells_pose(view: BoardView, parameters: Array, model: LensModel) -> bool:
    """Whether a view's points determine a pose of the board."""
    try:
        board_pose(view, parameters, model)
    except PerceptionError:
        return False
    return True


def board_pose(view: BoardView, parameters: Array, model: LensModel) -> Array:
    """`T_lens_board` (4, 4) with the least reprojection error of the view.

    Raises PerceptionError if the points do not determine a pose.
    """
    plane = model.plane(view.pixels, parameters)
    found, rotation, translation = False, None, None
    if np.isfinite(plane).all():
        found, rotation, translation = cv2.solvePnP(
            view.points, plane, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    if found and rotation is not None and translation is not None:
        T_lens_board = from_vector(np.concatenate([rotation.ravel(), translation.ravel()]))
        # The points are in front of the lens; the board's origin need not be visible and may be behind it.
        if (apply(T_lens_board, view.points)[:, 2] > 0).all():
            return T_lens_board
    raise PerceptionError(f"{len(view.ids)} points do not determine the pose of the board")


def _check_views(usable: Sequence[BoardView], offered: int) -> None:
    if len(usable) < MIN_VIEWS:
        raise PerceptionError(
            f"the board was found with at least {MIN_POINTS} points in {len(usable)} of {offered} views; "
            f"{MIN_VIEWS} are needed, 20 are good: hold it still, lit and in focus, and check --board"
        )


def _check_geometry(
    views: Sequence[BoardView],
    poses: Array,
    width_px: int,
    height_px: int,
    parameters: Array,
    model: LensModel,
) -> None:
    # Tilt is the angle between viewing ray and normal; normals alone would not show a pure pan.
    normals = poses[:, :3, 2]
    tilt = float(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    if tilt < MIN_TILT:
        raise PerceptionError(
            f"all views show the board from the same side: its normal rotates by {np.degrees(tilt):.1f} deg; "
            f"at least {np.degrees(MIN_TILT):.0f} deg are needed: tilt the scope left, right, up and down"
        )
    pixels = np.concatenate([view.pixels for view in views])
    span = np.ptp(pixels, axis=0) / min(width_px, height_px)
    if span.min() < MIN_COVERAGE:
        raise PerceptionError(
            f"the board covers {100 * span.min():.0f} % of the image; at least {100 * MIN_COVERAGE:.0f} % "
            "are needed: show it close and in every part of the image"
        )


def _start(views: Sequence[BoardView], width_px: int, height_px: int, model: LensModel) -> Array:
    """Parameters of the undistorted lens whose focal length fits best, by a few of the views."""
    step = max(1, len(views) // 12)
    best: tuple[float, Array] | None = None
    for focal in np.geomspace(0.3, 3.0, 15) * max(width_px, height_px):
        parameters = model.start(width_px, height_px, float(focal))
        try:
            errors = [
                _residuals(view, board_pose(view, parameters, model), parameters, model)
                for view in views[::step]
            ]
        except (PerceptionError, cv2.error):
            continue
        rms = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
        if np.isfinite(rms) and (best is None or rms < best[0]):
            best = rms, parameters
    if best is None:
        raise PerceptionError("no focal length fits the views: is --board the board in the images?")
    return best[1]


def _residuals(view: BoardView, T_lens_board: Array, parameters: Array, model: LensModel) -> Array:
    projected = model.project(apply(T_lens_board, view.points), parameters).pixels
    return np.asarray(projected - view.pixels)


class _State(NamedTuple):
    """Parameters of the lens (m,) and T_lens_board of each view (n, 4, 4)."""

    parameters: Array
    poses: Array


@dataclass(frozen=True)
class _Bundle:
    """The reprojection errors of all views, as a problem for `bundle.minimise`."""

    views: Sequence[BoardView]
    model: LensModel

    def blocks(self, state: _State) -> list[Block]:
        return [
            self._block(view, pose, state.parameters)
            for view, pose in zip(self.views, state.poses, strict=True)
        ]

    def _block(self, view: BoardView, T_lens_board: Array, parameters: Array) -> Block:
        projection = self.model.project(apply(T_lens_board, view.points), parameters)
        R = T_lens_board[:3, :3]
        by_twist = np.concatenate([-R @ skew(view.points), np.broadcast_to(R, (len(view.ids), 3, 3))], axis=2)
        return block(
            (projection.pixels - view.pixels).ravel(),
            projection.by_parameter[:, :, self.model.free].reshape(2 * len(view.ids), -1),
            (projection.by_point @ by_twist).reshape(-1, 6),
        )

    def cost(self, state: _State) -> float:
        with np.errstate(all="ignore"):
            errors = [
                _residuals(view, pose, state.parameters, self.model)
                for view, pose in zip(self.views, state.poses, strict=True)
            ]
            cost = float((np.concatenate(errors) ** 2).sum())
        return cost if np.isfinite(cost) else np.inf

    def moved(self, state: _State, shared_step: Array, own_steps: Sequence[Array]) -> _State:
        parameters = state.parameters.copy()
        parameters[self.model.free] += shared_step
        poses = np.array([T @ from_vector(step) for T, step in zip(state.poses, own_steps, strict=True)])
        return _State(parameters, poses)


def _without_outliers(
    views: Sequence[BoardView], parameters: Array, poses: Array, model: LensModel
) -> tuple[list[BoardView], Array, int]:
    """The views without outlying points, by a robust standard deviation, and the number of outliers."""
    lengths = [
        np.linalg.norm(_residuals(view, pose, parameters, model), axis=1)
        for view, pose in zip(views, poses, strict=True)
    ]
    # The median length of a 2D Gaussian vector is 1.1774 sigma.
    sigma = float(np.median(np.concatenate(lengths))) / 1.1774
    limit = max(OUTLIER_SIGMAS * sigma, OUTLIER_FLOOR_PX)
    kept, kept_poses, dropped = [], [], 0
    for view, pose, length in zip(views, poses, lengths, strict=True):
        good = length <= limit
        dropped += int((~good).sum())
        if good.sum() >= MIN_POINTS:
            kept.append(view._replace(ids=view.ids[good], points=view.points[good], pixels=view.pixels[good]))
            kept_poses.append(pose)
    return kept, np.array(kept_poses), dropped


def _result(
    views: Sequence[BoardView],
    parameters: Array,
    poses: Array,
    model: LensModel,
    size: tuple[int, int],
    dropped: int,
) -> IntrinsicsFit:
    blocks = _Bundle(views, model).blocks(_State(parameters, poses))
    information = np.sum([b.reduced()[0] for b in blocks], axis=0)
    residuals = [_residuals(view, pose, parameters, model) for view, pose in zip(views, poses, strict=True)]
    squares = np.array([(residual**2).sum() for residual in residuals])
    effect = design_effect(views, residuals)
    points = np.array([len(view.ids) for view in views])
    freedom = 2 * points.sum() - 6 * len(views) - model.free.sum()
    variance = squares.sum() / freedom
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(model.free, model.free)] = effect * variance * np.linalg.inv(information)
    covariance += systematic(len(parameters), bias_of(views))
    fx, fy, cx, cy = (float(value) for value in parameters[:4])
    distortion = list(map(float, parameters[4:]))
    intrinsics = Intrinsics(
        width=size[0],
        height=size[1],
        distortion_model=model.distortion_model,
        k=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        d=tuple(distortion),
        covariance=covariance,
        rms_px=float(np.sqrt(squares.sum() / points.sum())),
        sigma_px=float(np.sqrt(variance)),
        design_effect=effect,
        view_count=len(views),
        point_count=int(points.sum()),
    )
    return IntrinsicsFit(intrinsics, tuple(views), poses, np.sqrt(squares / points), dropped)


def bias_of(views: Sequence[BoardView]) -> float:
    """The largest bias [px] of the points of views."""
    return max(view.bias_px for view in views)


def systematic(parameter_count: int, bias_px: float) -> Array:
    """Covariance (m, m) of the lens by a bias of the points common to all views, which no residual shows."""
    sigma = np.zeros(parameter_count)
    # Half the field of view is about half a radian: a bias there moves the focal length by twice as much.
    sigma[:4] = 2 * bias_px, 2 * bias_px, bias_px, bias_px
    return np.diag(sigma**2)


def design_effect(views: Sequence[BoardView], residuals: Sequence[Array]) -> float:
    """Design effect: variance of a mean over points, relative to that with independent errors; at least 1.

    It is 1 + the sum of the correlations with all neighbours, up to the distance, in spacings of the points,
    at which they are not clearly above zero any more. Errors of neighbours are correlated if the lens differs
    from its model, the board is not flat or the image is blurred; many points then carry little more
    information than a few.
    """
    sums, pairs, square, points = np.zeros(CORRELATION_RANGE), np.zeros(CORRELATION_RANGE), 0.0, 0
    for view, residual in zip(views, residuals, strict=True):
        apart = np.linalg.norm(view.pixels[:, None] - view.pixels[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        apart = apart / np.median(apart.min(axis=1))
        np.fill_diagonal(apart, 0.0)
        lag = (
            np.digitize(apart[np.triu_indices(len(residual), 1)], np.arange(CORRELATION_RANGE + 1) + 0.5) - 1
        )
        product = (residual @ residual.T)[np.triu_indices(len(residual), 1)]
        near = (lag >= 0) & (lag < CORRELATION_RANGE)
        sums += np.bincount(lag[near], product[near], CORRELATION_RANGE)
        pairs += np.bincount(lag[near], minlength=CORRELATION_RANGE)
        square += float((residual**2).sum())
        points += len(residual)
    correlation = sums / np.maximum(pairs, 1) / (square / points)
    clear = correlation > 2 / np.sqrt(2 * np.maximum(pairs, 1))
    reach = CORRELATION_RANGE if clear.all() else int(clear.argmin())
    return float(1 + 2 * sums[:reach].sum() / square)
