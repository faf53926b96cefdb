"""Fit of the network's parameters to batches of examples."""

import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.pixel_classes import UNKNOWN_CLASS, PixelClass
from knee_gap_perception.training.model import Parameters, jax_modules, logits, statistics

# Weights of the classes: openings and instruments are few pixels.
CLASS_WEIGHTS = (0.2, 1.0, 2.0, 2.0, 1.5)
OVERLAP_WEIGHT = 0.5  # of the gap's soft Dice beside the cross-entropy
SMOOTHING = 0.05  # of the labels, which were drawn by hand
DECAY = 1e-4
WARM_UP_SHARE = 0.05
AVERAGED = 0.98  # of the parameters' running mean that a step keeps


class Batch(NamedTuple):
    """Inputs (n, side, side, channels) and classes (n, side / 2, side / 2)."""

    inputs: npt.NDArray[np.float32]
    labels: npt.NDArray[np.uint8]


def fit(
    parameters: Parameters,
    batches: Iterator[Batch],
    steps: int,
    rate: float,
    report: Callable[[int, float, float], None],
) -> Parameters:
    """The running mean of the parameters over `steps` batches, from some parameters on.

    `report` receives the step, the mean loss since its last call, and the CPU time [s] since the start.
    """
    jax = jax_modules()
    step_of, optimiser = _step()
    now: Any = jax.tree_util.tree_map(jax.numpy.asarray, parameters)
    mean, state = now, optimiser.init(now)
    begun, losses = time.process_time(), []
    for index in range(steps):
        batch = next(batches)
        kept = min(AVERAGED, (1.0 + index) / (10.0 + index))
        labels = batch.labels.astype(np.int32)
        now, mean, state, loss = step_of(
            now, mean, state, (batch.inputs, labels), rate_at(index, steps, rate), kept
        )
        losses.append(loss)
        if (index + 1) % 25 == 0 or index + 1 == steps:
            report(index + 1, float(np.mean(losses)), time.process_time() - begun)
            losses = []
    return {name: np.asarray(value, np.float32) for name, value in mean.items()}


def layer_statistics(parameters: Parameters, batches: Iterator[Batch], count: int) -> Parameters:
    """Means and variances of the normalised layers over some batches: `NAME.mean` and `NAME.variance`."""
    jax = jax_modules()
    compute = jax.jit(statistics)
    total: dict[str, Any] = {}
    for _ in range(count):
        for name, (mean, variance) in compute(parameters, next(batches).inputs).items():
            for part, value in (("mean", mean), ("variance", variance)):
                key = f"{name}.{part}"
                total[key] = total.get(key, 0.0) + np.asarray(value, np.float64) / count
    return {name: np.asarray(value, np.float32) for name, value in total.items()}


def _loss(parameters: Any, inputs: Any, labels: Any) -> Any:
    """Weighted cross-entropy, and the soft Dice of the gap where there is one."""
    jax = jax_modules()
    jnp = jax.numpy
    known = labels != UNKNOWN_CLASS
    label = jnp.where(known, labels, 0)
    weight = jnp.where(known, jnp.asarray(CLASS_WEIGHTS)[label], 0.0)
    output = logits(parameters, inputs)
    score = jax.nn.log_softmax(output)
    right = jnp.take_along_axis(score, label[..., None].astype(jnp.int32), axis=-1)[..., 0]
    entropy = -((1.0 - SMOOTHING) * right + SMOOTHING * score.mean(axis=-1))
    gap = jnp.where(known, jnp.exp(score[..., PixelClass.GAP]), 0.0)
    wanted = jnp.where(known, label == PixelClass.GAP, False)
    shared = (gap * wanted).sum(axis=(1, 2))
    both = gap.sum(axis=(1, 2)) + wanted.sum(axis=(1, 2))
    dice = (2.0 * shared + 20.0) / (both + 20.0)
    return (weight * entropy).sum() / weight.sum() + OVERLAP_WEIGHT * (1.0 - dice).mean()


def rate_at(step: int, steps: int, most: float) -> float:
    """Rate of learning at a step: it rises, then falls with a cosine to a hundredth."""
    rise = max(1, round(WARM_UP_SHARE * steps))
    if step < rise:
        return most * (step + 1) / rise
    return most * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * (step - rise) / max(1, steps - rise)))))


@cache
def _step() -> tuple[Callable[..., Any], Any]:
    """One compiled step, and the optimiser."""
    jax = jax_modules()
    import optax

    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.scale_by_adam(), optax.add_decayed_weights(DECAY)
    )

    def step(now: Any, mean: Any, state: Any, batch: Any, rate: Any, kept: Any) -> Any:
        loss, gradient = jax.value_and_grad(_loss)(now, *batch)
        updates, state = optimiser.update(gradient, state, now)
        now = jax.tree_util.tree_map(lambda value, update: value - rate * update, now, updates)
        mean = jax.tree_util.tree_map(lambda old, new: kept * old + (1.0 - kept) * new, mean, now)
        return now, mean, state, loss

    return jax.jit(step), optimiser
