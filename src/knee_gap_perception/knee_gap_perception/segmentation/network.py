"""Segmentation by a neural network of the laboratory (ONNX), run by OpenCV."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_perception.errors import PerceptionError


class Network:
    """An ONNX network from an image (1, 3, height, width) to the gap (1, classes, height, width).

    With one output channel, a value above `threshold` is the gap. With several, the gap is where channel
    `gap_channel` is the largest. The input is (image - mean) * scale per channel, in red, green, blue.

    Raises PerceptionError if the file is missing, if OpenCV cannot read it, or if the output has another
    shape.
    """

    def __init__(
        self,
        path: str,
        *,
        input_size: tuple[int, int] = (256, 256),
        mean: tuple[float, float, float] = (0.0, 0.0, 0.0),
        scale: tuple[float, float, float] = (1 / 255, 1 / 255, 1 / 255),
        threshold: float = 0.5,
        gap_channel: int = 1,
    ) -> None:
        """`input_size` is width and height [px]; `mean` and `scale` are of red, green, blue."""
        if not Path(path).is_file():
            raise PerceptionError(f"network_path must be an ONNX file; '{path}' is not a file")
        try:
            self._net = cv2.dnn.readNetFromONNX(path)
        except cv2.error as error:
            raise PerceptionError(f"OpenCV cannot read the network '{path}': {error.err}") from error
        self._path, self._size = path, input_size
        self._mean = np.array(mean, np.float32)
        self._scale = np.array(scale, np.float32)
        self._threshold, self._gap_channel = threshold, gap_channel

    def __call__(self, image: Image, field: Mask) -> Mask:
        """Dark pixels (h, w) of an image (h, w, 3) within `field` (h, w)."""
        resized = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        picture = (cv2.cvtColor(resized, cv2.COLOR_BGR2RGB).astype(np.float32) - self._mean) * self._scale
        self._net.setInput(np.ascontiguousarray(picture.transpose(2, 0, 1)[None]))
        try:
            output = np.asarray(self._net.forward(), np.float32)
        except cv2.error as error:
            raise PerceptionError(f"the network '{self._path}' does not run: {error.err}") from error
        score = self._gap_score(output)
        height, width = field.shape
        return np.asarray(field & (cv2.resize(score, (width, height), interpolation=cv2.INTER_LINEAR) > 0))

    def _gap_score(self, output: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Score (h, w) of a network's output, above 0 where the gap is."""
        if output.ndim != 4 or output.shape[0] != 1 or not 0 <= self._gap_channel < max(output.shape[1], 2):
            raise PerceptionError(
                "the network's output must be (1, channels, height, width) "
                f"with channel {self._gap_channel}, not {output.shape}"
            )
        if output.shape[1] == 1:
            return np.asarray(output[0, 0] - np.float32(self._threshold))
        others = np.delete(output[0], self._gap_channel, axis=0).max(axis=0)
        return np.asarray(output[0, self._gap_channel] - others)
