"""Image formation from light: exposure, blur of the lens, sensor noise, tone curve, JPEG."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_simulation.errors import SimulationError

FloatImage = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Sensor:
    """The camera head.

    ``target`` is the mean display brightness that the automatic exposure aims at, ``settle_s`` its time
    constant; ``blur_px`` is the blur of the lens; ``shot_noise`` and ``read_noise`` are RMS values at full
    scale, in linear light (full scale 1).
    """

    target: float = 0.40
    settle_s: float = 0.25
    blur_px: float = 1.1
    shot_noise: float = 0.006
    read_noise: float = 0.0012

    def __post_init__(self) -> None:
        if not 0.0 < self.target < 1.0:
            raise SimulationError(f"target must lie in (0, 1), not {self.target}")


class AutoExposure:
    """Gain that follows the mean brightness inside the field stop, as a camera's control does."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._log_gain: float | None = None

    def gain(self, radiance: FloatImage, weight: FloatImage, step_s: float) -> float:
        """Gain for a linear image (h, w, 3), metered with weights (h, w), ``step_s`` after the last one."""
        luminance = radiance[::8, ::8] @ np.array([0.1, 0.6, 0.3], np.float32)
        metered = weight[::8, ::8]
        # Metering uses the square root, close to the display curve, so that glare does not darken the image.
        level = float((np.sqrt(luminance) * metered).sum() / metered.sum())
        wanted = 2.0 * np.log(self._sensor.target / max(level, 1e-4))
        if self._log_gain is None:
            self._log_gain = wanted
        else:
            self._log_gain += (wanted - self._log_gain) * (1.0 - np.exp(-step_s / self._sensor.settle_s))
        return float(np.exp(self._log_gain))


def tone_table() -> ByteImage:
    """Display values (4096,) of linear light in [0, 2): a gamma with a soft shoulder to white."""
    linear = np.arange(4096) / 2048.0
    shouldered = np.where(linear < 0.6, linear, 0.6 + 0.4 * np.tanh((linear - 0.6) / 0.4))
    return np.asarray(np.round(255.0 * np.clip(shouldered, 0.0, 1.0) ** (1.0 / 2.2)), dtype=np.uint8)


_TONE = tone_table()


def develop(
    radiance: FloatImage, stop: FloatImage, gain: float, sensor: Sensor, rng: np.random.Generator
) -> ByteImage:
    """Display image (h, w, 3) bgr8 of a linear image (h, w, 3) behind a field stop (h, w)."""
    exposed = cv2.GaussianBlur(radiance, (0, 0), sensor.blur_px) * np.float32(gain) * stop[..., None]
    noise = rng.standard_normal(exposed.shape, dtype=np.float32)
    sigma = np.sqrt(sensor.shot_noise**2 * exposed + np.float32(sensor.read_noise**2))
    # Beyond the field stop the processor shows plain black.
    exposed += noise * sigma * (stop[..., None] > 0.0)
    return np.asarray(_TONE[np.clip(exposed * 2048.0, 0.0, 4095.0).astype(np.uint16)])


def jpeg(image: ByteImage, quality: int) -> bytes:
    """The image (h, w, 3) bgr8 as JPEG."""
    if not 1 <= quality <= 100:
        raise SimulationError(f"JPEG quality must lie in [1, 100], not {quality}")
    done, data = cv2.imencode(
        ".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    )
    if not done:
        raise SimulationError("OpenCV could not encode the image as JPEG")
    return data.tobytes()


def decoded(data: bytes) -> ByteImage:
    """The image (h, w, 3) bgr8 of a JPEG."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
