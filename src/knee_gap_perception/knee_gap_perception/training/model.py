"""The network in JAX: its parameters, and what it computes.

JAX is an extra (`make training`); it is imported by need, so that the package works without it.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.network_input import CHANNELS
from knee_gap_perception.training.architecture import network

Parameters = dict[str, npt.NDArray[np.float32]]
EPSILON = 1e-3  # added to a variance


def jax_modules() -> Any:
    """JAX's `jax` module. Raises PerceptionError if the extra is not installed."""
    try:
        import jax
    except ImportError:
        raise PerceptionError("training needs JAX, optax and onnx: run make training") from None
    return jax


@dataclass
class _Shapes:
    """Follows the number of channels alone, and notes the parameters that are needed."""

    rng: np.random.Generator
    parameters: Parameters = field(default_factory=dict)

    def layer(self, name: str, x: int, width: int, size: int = 3, stride: int = 1) -> int:
        del stride
        inputs = size * size * x
        kernel = self.rng.normal(0.0, np.sqrt(2.0 / inputs), (inputs, width))
        self.parameters[f"{name}.kernel"] = kernel.astype(np.float32)
        self.parameters[f"{name}.scale"] = np.ones(width, np.float32)
        self.parameters[f"{name}.shift"] = np.zeros(width, np.float32)
        return width

    def linear(self, name: str, x: int, width: int) -> int:
        kernel = self.rng.normal(0.0, np.sqrt(1.0 / x), (x, width))
        self.parameters[f"{name}.kernel"] = kernel.astype(np.float32)
        self.parameters[f"{name}.shift"] = np.zeros(width, np.float32)
        return width

    def add(self, x: int, y: int) -> int:
        assert x == y
        return x

    def twice(self, x: int) -> int:
        return x

    def mean(self, x: int) -> int:
        return x


class _Compute:
    """Computes on arrays (n, h, w, channels) of JAX, normalised by each batch; notes its statistics."""

    def __init__(self, parameters: Any) -> None:
        self._jnp: Any = jax_modules().numpy
        self._parameters = parameters
        self.statistics: dict[str, tuple[Any, Any]] = {}

    def layer(self, name: str, x: Any, width: int, size: int = 3, stride: int = 1) -> Any:
        jnp, parameters = self._jnp, self._parameters
        y = self._convolved(x, parameters[f"{name}.kernel"], size, stride)
        mean = y.mean(axis=(0, 1, 2))
        variance = ((y - mean) ** 2).mean(axis=(0, 1, 2))
        self.statistics[name] = (mean, variance)
        y = (y - mean) / jnp.sqrt(variance + EPSILON)
        return jnp.maximum(y * parameters[f"{name}.scale"] + parameters[f"{name}.shift"], 0.0)

    def linear(self, name: str, x: Any, width: int) -> Any:
        return x @ self._parameters[f"{name}.kernel"] + self._parameters[f"{name}.shift"]

    def add(self, x: Any, y: Any) -> Any:
        return x + y

    def twice(self, x: Any) -> Any:
        return self._jnp.repeat(self._jnp.repeat(x, 2, axis=1), 2, axis=2)

    def mean(self, x: Any) -> Any:
        return x.mean(axis=(1, 2), keepdims=True)

    def _convolved(self, x: Any, kernel: Any, size: int, stride: int) -> Any:
        if size == 1:
            return x @ kernel
        places = kernel.reshape(size, size, x.shape[-1], -1)
        pad = (size // 2, size // 2)
        convolution = jax_modules().lax.conv_general_dilated
        return convolution(
            x, places, (stride, stride), (pad, pad), dimension_numbers=("NHWC", "HWIO", "NHWC")
        )


def drawn(seed: int) -> Parameters:
    """Parameters to begin with, drawn from a seed."""
    shapes = _Shapes(np.random.default_rng([seed, 0x4E45]))
    network(shapes, CHANNELS)
    return shapes.parameters


def logits(parameters: Any, x: Any) -> Any:
    """Logits (n, side / 2, side / 2, classes) of inputs (n, side, side, channels)."""
    return network(_Compute(parameters), x)


def statistics(parameters: Any, x: Any) -> dict[str, tuple[Any, Any]]:
    """Mean and variance (width,) of each normalised layer over a batch of inputs."""
    compute = _Compute(parameters)
    network(compute, x)
    return compute.statistics
