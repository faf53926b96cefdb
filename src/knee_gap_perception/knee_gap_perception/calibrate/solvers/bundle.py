"""Bundle adjustment by Levenberg-Marquardt: views with shared unknowns and unknowns of their own.

The unknowns of each view are eliminated by a Schur complement, so the cost grows with the number of views,
not with its cube (Triggs et al. 1999). Used for the lens with a board pose per view, and for the hand-eye
transform with a tracker error per view.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from knee_gap_core.values.arrays import Array

State = TypeVar("State")


class Block(NamedTuple):
    """Normal equations of one view: squared error, J^T J and J^T r by shared (m) and own (l) unknowns."""

    square: float
    shared: Array
    mixed: Array
    own: Array
    shared_gradient: Array
    own_gradient: Array

    def reduced(self) -> tuple[Array, Array]:
        """Information (m, m) and gradient (m,) of the shared unknowns, the view's own eliminated."""
        eliminated = np.linalg.solve(self.own, np.column_stack([self.mixed.T, self.own_gradient]))
        return self.shared - self.mixed @ eliminated[:, :-1], self.shared_gradient - self.mixed @ eliminated[
            :, -1
        ]


def block(residual: Array, by_shared: Array, by_own: Array) -> Block:
    """Normal equations of residuals (k,) with derivatives (k, m) and (k, l)."""
    return Block(
        float(residual @ residual),
        by_shared.T @ by_shared,
        by_shared.T @ by_own,
        by_own.T @ by_own,
        by_shared.T @ residual,
        by_own.T @ residual,
    )


class Problem(Protocol[State]):
    """Interface of a minimisation problem: a sum of squares over views."""

    def blocks(self, state: State) -> Sequence[Block]:
        """Normal equations of every view at a state."""

    def cost(self, state: State) -> float:
        """Sum of squares; infinite if the state is impossible."""

    def moved(self, state: State, shared_step: Array, own_steps: Sequence[Array]) -> State:
        """The state after a step of the shared unknowns (m,) and of each view's own (l,)."""


def minimise(problem: Problem[State], state: State, iterations: int = 60) -> State:
    """State of least squares that Levenberg-Marquardt reaches from an initial state."""
    cost, damping = problem.cost(state), 1e-3
    for _ in range(iterations):
        blocks = problem.blocks(state)
        trial, trial_cost = state, np.inf
        while damping < 1e10:
            trial = problem.moved(state, *_step(blocks, damping))
            trial_cost = problem.cost(trial)
            if trial_cost < cost:
                break
            damping *= 10
        else:
            return state
        improvement = cost - trial_cost
        state, cost, damping = trial, trial_cost, damping / 10
        if improvement < 1e-10 * cost + 1e-15:
            break
    return state


def _step(blocks: Sequence[Block], damping: float) -> tuple[Array, list[Array]]:
    """Steps with Marquardt's damping of the diagonals."""
    damped = [
        b._replace(
            shared=b.shared + damping * np.diag(np.diag(b.shared)),
            own=b.own + damping * np.diag(np.diag(b.own)),
        )
        for b in blocks
    ]
    information, gradient = (
        np.sum(parts, axis=0) for parts in zip(*(b.reduced() for b in damped), strict=True)
    )
    shared_step = -np.linalg.solve(information, gradient)
    own_steps = [-np.linalg.solve(b.own, b.own_gradient + b.mixed.T @ shared_step) for b in damped]
    return shared_step, own_steps
