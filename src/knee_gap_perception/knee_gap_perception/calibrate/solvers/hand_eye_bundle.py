"""Hand-eye calibration as a bundle adjustment: errors of all views, derivatives, and tracker errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import apply, from_vector, inverse, skew
from knee_gap_perception.calibrate.measurements.boards import BoardView
from knee_gap_perception.calibrate.solvers.bundle import Block, block
from knee_gap_perception.camera.projection import LensModel, Projection
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis, about, roll

SAME_TURN = np.radians(3.0)  # range of scope rotations that the closed-form solvers treat as one
KNOWN_TURN = 1e-7  # [rad] standard error of a rotation that is treated as exact
RATIO_SIGMA = 1.0  # [-] prior standard deviation of the logarithm of rotation error over shift error


class TrackedView(NamedTuple):
    """A board in an image and the tracked body at the same time.

    `twist_rate` (6,) is the body's velocity in its own frame [rad/s, m/s]. `scope_rotation` [rad] is the
    rotation of an oblique scope in its camera head since the reference, 0 if it is fixed, and `turn_sigma`
    its standard error.
    """

    board: BoardView
    T_world_body: Array
    twist_rate: Array
    scope_rotation: float = 0.0
    turn_sigma: float = 0.0


class HandEyeState(NamedTuple):
    """All unknowns of the fit; `errors` (n, 7) of each view are a twist of the body and a rotation."""

    T_body_lens: Array
    T_world_board: Array
    lens: Array
    time_offset: float
    axis: ShaftAxis | None
    errors: Array


class LinearView(NamedTuple):
    """One view at a state: residual (2n,) [px], derivatives by shared unknowns, lens and errors."""

    residual: Array
    by_shared: Array
    by_lens: Array
    by_error: Array


@dataclass(frozen=True)
class HandEyeBundle:
    """Reprojection errors and tracker errors of all views, as a problem for `bundle.minimise`.

    Shared unknowns, in order: twist of T_body_lens (6), twist of T_world_board (6), the free ones of the
    lens, the time offset (1), tilt (2) and shift (2) of the shaft's axis. The standard deviations are those
    of one pixel coordinate and of the components of a pose error (6,).
    """

    views: tuple[TrackedView, ...]
    model: LensModel
    free_lens: bool
    timed: bool
    mount: Mount
    sigma_px: float
    pose_sigma: Array

    @property
    def has_axis(self) -> bool:
        """Whether the axis of the shaft is among the unknowns."""
        return needs_axis(self.views, self.mount)

    def blocks(self, state: HandEyeState) -> list[Block]:
        """Normal equations of every view."""
        return [
            self._block(self.linear(i, state), state.errors[i], sigma)
            for i, sigma in enumerate(self.error_sigma(self.pose_sigma))
        ]

    def error_sigma(self, pose_sigma: Array) -> Array:
        """Standard deviations (n, 7) of the errors of each view."""
        turn = np.maximum([view.turn_sigma for view in self.views], KNOWN_TURN)
        return np.column_stack([np.tile(pose_sigma, (len(self.views), 1)), turn])

    def _block(self, linear: LinearView, error: Array, sigma: Array) -> Block:
        return block(
            np.concatenate([linear.residual / self.sigma_px, error / sigma]),
            np.concatenate([linear.by_shared / self.sigma_px, np.zeros((7, linear.by_shared.shape[1]))]),
            np.concatenate([linear.by_error / self.sigma_px, np.diag(1 / sigma)]),
        )

    def cost(self, state: HandEyeState) -> float:
        """Sum of squares; infinite if a point cannot be projected."""
        with np.errstate(all="ignore"):
            errors = [
                self._seen(i, state).projection.pixels - v.board.pixels for i, v in enumerate(self.views)
            ]
            cost = float((np.concatenate(errors) ** 2).sum()) / self.sigma_px**2
        cost += float(((state.errors / self.error_sigma(self.pose_sigma)) ** 2).sum())
        return cost if np.isfinite(cost) else np.inf

    def moved(self, state: HandEyeState, shared_step: Array, own_steps: Sequence[Array]) -> HandEyeState:
        """The state after a step."""
        X = state.T_body_lens @ from_vector(shared_step[:6])
        Z = state.T_world_board @ from_vector(shared_step[6:12])
        rest = shared_step[12:]
        lens, offset, axis = state.lens.copy(), state.time_offset, state.axis
        if self.free_lens:
            count = int(self.model.free.sum())
            lens[self.model.free] += rest[:count]
            rest = rest[count:]
        if self.timed:
            offset, rest = offset + float(rest[0]), rest[1:]
        if self.has_axis and axis is not None:
            basis = _across(axis.direction)
            direction = axis.direction + basis @ rest[:2]
            axis = ShaftAxis(direction / np.linalg.norm(direction), axis.point + basis @ rest[2:])
        return HandEyeState(X, Z, lens, offset, axis, state.errors + np.array(own_steps))

    def _seen(self, index: int, state: HandEyeState) -> "_Seen":
        view, error = self.views[index], state.errors[index]
        turn = view.scope_rotation + float(error[6])
        moved = from_vector(state.time_offset * view.twist_rate) @ from_vector(error[:6])
        T_body_board = inverse(moved) @ inverse(view.T_world_body) @ state.T_world_board
        body = apply(T_body_board, view.board.points)
        unturned = body if state.axis is None else apply(state.axis.turned(-turn), body)
        lens = apply(inverse(state.T_body_lens), unturned)
        projection = self.model.project(apply(roll(turn), lens), state.lens)
        return _Seen(projection, turn, T_body_board, body, unturned, lens)

    def linear(self, index: int, state: HandEyeState) -> LinearView:
        """Residual and derivatives of one view."""
        view, seen = self.views[index], self._seen(index, state)
        count, turn = len(seen.body), seen.turn
        Rz, R_lens_body = roll(turn)[:3, :3], state.T_body_lens[:3, :3].T
        back = np.eye(3) if state.axis is None else about(state.axis.direction, -turn)
        to_lens = Rz @ R_lens_body @ back
        by_point = seen.projection.by_point

        def by_twist(rotation: Array, translation: Array) -> Array:
            parts = [rotation, np.broadcast_to(translation, (count, 3, 3))]
            return np.asarray(by_point @ np.concatenate(parts, axis=2))

        R_lens_board = to_lens @ seen.T_body_board[:3, :3]
        by_body_twist = by_twist(to_lens @ skew(seen.body), -to_lens)
        by_turn = np.cross([0.0, 0.0, 1.0], seen.lens @ Rz.T)
        columns = [
            by_twist(Rz @ skew(seen.lens), -Rz),
            by_twist(-R_lens_board @ skew(view.board.points), R_lens_board),
        ]
        if self.free_lens:
            columns.append(seen.projection.by_parameter[:, :, self.model.free])
        if self.timed:
            columns.append((by_body_twist @ view.twist_rate)[:, :, None])
        if state.axis is not None:
            direction, point = state.axis.direction, state.axis.point
            by_turn = by_turn - np.cross(direction, seen.unturned - point) @ (Rz @ R_lens_body).T
            if self.has_axis:
                columns.append(by_point @ Rz @ R_lens_body @ _by_axis(seen.body - point, direction, turn))
        by_error = np.concatenate([by_body_twist, by_point @ by_turn[:, :, None]], axis=2)
        return LinearView(
            (seen.projection.pixels - view.board.pixels).ravel(),
            np.concatenate(columns, axis=2).reshape(2 * count, -1),
            seen.projection.by_parameter.reshape(2 * count, -1),
            by_error.reshape(2 * count, 7),
        )


class _Seen(NamedTuple):
    """A view at a state: rotation of the scope, and the points in the body, rotated body and lens frames."""

    projection: Projection
    turn: float
    T_body_board: Array
    body: Array
    unturned: Array
    lens: Array


def needs_axis(views: Sequence[TrackedView], mount: Mount) -> bool:
    """Whether the scope rotates in a camera head to which the tracked body is fixed."""
    return mount is Mount.CAMERA_HEAD and float(np.ptp([view.scope_rotation for view in views])) > SAME_TURN


def _across(direction: Array) -> Array:
    """Two unit vectors (3, 2) perpendicular to a direction."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:].T)


def _by_axis(from_axis: Array, direction: Array, turn: float) -> Array:
    """Change (n, 3, 4) of points (n, 3), given from a point of the axis, by its tilts and shifts."""
    basis = _across(direction)
    # Rodrigues' formula for the angle -turn, differentiated by the direction.
    cosine, sine = np.cos(turn), -np.sin(turn)
    outer = direction[None, :, None] * from_axis[:, None, :]
    along = (from_axis @ direction)[:, None, None] * np.eye(3)
    by_tilt = (-sine * skew(from_axis) + (1 - cosine) * (along + outer)) @ basis
    by_shift = np.broadcast_to((np.eye(3) - about(direction, -turn)) @ basis, by_tilt.shape)
    return np.concatenate([by_tilt, by_shift], axis=2)


def tracker_sigma(bundle: HandEyeBundle, state: HandEyeState, presumed: Array) -> Array:
    """Restricted maximum likelihood of the tracker's error (6,): multiples of the prior errors."""
    pixels = [
        block(x.residual - x.by_error @ e, x.by_shared, x.by_error)
        for x, e in ((bundle.linear(i, state), state.errors[i]) for i in range(len(bundle.views)))
    ]
    variance = bundle.sigma_px**2

    def negative(log_scale: Array) -> float:
        sigma = np.repeat(np.exp(log_scale), 3) * presumed
        information, cost = np.zeros_like(pixels[0].shared), 0.0
        gradient = np.zeros_like(pixels[0].shared_gradient)
        for b, error_sigma in zip(pixels, bundle.error_sigma(sigma), strict=True):
            view = _scaled(b, variance, error_sigma)
            reduced, by_shared = view.reduced()
            information, gradient = information + reduced, gradient + by_shared
            cost += view.square - float(view.own_gradient @ np.linalg.solve(view.own, view.own_gradient))
            cost += float(np.linalg.slogdet(view.own)[1]) + 2 * float(np.log(error_sigma).sum())
        scale = np.sqrt(np.diag(information))
        cost -= float(gradient @ np.linalg.solve(information, gradient))
        cost += float(np.linalg.slogdet(information / np.outer(scale, scale))[1])
        cost += 2 * float(np.log(scale).sum())
        # Few views cannot separate rotation from shift; the prior ratio then decides.
        return float(cost + ((log_scale[0] - log_scale[1]) / RATIO_SIGMA) ** 2)

    start = np.log([bundle.pose_sigma[0] / presumed[0], bundle.pose_sigma[3] / presumed[3]])
    limits = [(np.log(0.05), np.log(500.0))] * 2
    best = minimize(
        negative, start, method="Nelder-Mead", bounds=limits, options={"xatol": 1e-2, "fatol": 1e-3}
    )
    return np.asarray(np.repeat(np.exp(best.x), 3) * presumed)


def _scaled(pixels: Block, variance: float, error_sigma: Array) -> Block:
    """Normal equations with the variance of a pixel and the prior of the errors."""
    return Block(
        pixels.square / variance,
        pixels.shared / variance,
        pixels.mixed / variance,
        pixels.own / variance + np.diag(error_sigma**-2),
        pixels.shared_gradient / variance,
        pixels.own_gradient / variance,
    )
