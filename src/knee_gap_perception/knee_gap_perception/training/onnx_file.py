"""The trained network as an ONNX file, with its normalisation folded into the convolutions."""

from pathlib import Path
from typing import Any

import numpy as np

from knee_gap_core.values.pixel_classes import PixelClass
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.segmentation.network_input import CHANNELS, SIDE
from knee_gap_perception.training.architecture import network
from knee_gap_perception.training.model import EPSILON, Parameters

OPSET = 13


class _Nodes:
    """Writes nodes instead of computing: a value is its name and its number of channels."""

    def __init__(self, parameters: Parameters, onnx: Any) -> None:
        """`parameters` with the statistics of the layers."""
        self._parameters, self._onnx = parameters, onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = [
            onnx.numpy_helper.from_array(np.array([1.0, 1.0, 2.0, 2.0], np.float32), "by_two")
        ]

    def layer(self, name: str, x: str, width: int, size: int = 3, stride: int = 1) -> str:
        scale = self._parameters[f"{name}.scale"] / np.sqrt(self._parameters[f"{name}.variance"] + EPSILON)
        kernel = self._parameters[f"{name}.kernel"] * scale
        offset = self._parameters[f"{name}.shift"] - self._parameters[f"{name}.mean"] * scale
        return self._node("Relu", name, self._convolution(name, x, kernel, offset, size, stride))

    def linear(self, name: str, x: str, width: int) -> str:
        kernel, offset = self._parameters[f"{name}.kernel"], self._parameters[f"{name}.shift"]
        return self._convolution(name, x, kernel, offset, 1, 1)

    def add(self, x: str, y: str) -> str:
        return self._node("Add", f"sum{len(self.nodes)}", x, y)

    def twice(self, x: str) -> str:
        return self._node(
            "Resize",
            f"twice{len(self.nodes)}",
            x,
            "",
            "by_two",
            mode="nearest",
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        )

    def mean(self, x: str) -> str:
        return self._node("GlobalAveragePool", f"mean{len(self.nodes)}", x)

    def _convolution(self, name: str, x: str, kernel: Any, offset: Any, size: int, stride: int) -> str:
        width = kernel.shape[1]
        # Rows of the kernel are places in the neighbourhood, then channels.
        weights = kernel.reshape(size, size, -1, width).transpose(3, 2, 0, 1)
        for part, value in (("weights", weights), ("offset", offset)):
            array = np.ascontiguousarray(value, np.float32)
            self.constants.append(self._onnx.numpy_helper.from_array(array, f"{name}.{part}"))
        pad = size // 2
        return self._node(
            "Conv",
            f"{name}.conv",
            x,
            f"{name}.weights",
            f"{name}.offset",
            kernel_shape=[size, size],
            strides=[stride, stride],
            pads=[pad] * 4,
        )

    def _node(self, kind: str, name: str, *inputs: str, **settings: Any) -> str:
        self.nodes.append(self._onnx.helper.make_node(kind, list(inputs), [name], name=name, **settings))
        return name


def write_network(parameters: Parameters, path: Path) -> None:
    """Write a network, from its parameters and the statistics of its layers.

    Raises PerceptionError if the extra is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise PerceptionError("training needs JAX, optax and onnx: run make training") from None
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    nodes = _Nodes(parameters, onnx)
    output = network(nodes, "picture")
    graph = helper.make_graph(
        nodes.nodes,
        "knee_gap_segmentation",
        [helper.make_tensor_value_info("picture", real, [1, CHANNELS, SIDE, SIDE])],
        [helper.make_tensor_value_info(output, real, [1, len(PixelClass), SIDE // 2, SIDE // 2])],
        nodes.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
