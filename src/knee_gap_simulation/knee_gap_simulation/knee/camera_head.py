"""The camera head of the knee simulator: focus, shutter, bloom, exposure, noise and sharpening."""

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.difficulty import Conditions
from knee_gap_simulation.scope.imaging import AutoExposure, ByteImage, FloatImage, Sensor, tone_table

FOCAL_DISTANCE = 0.012
_SHARPENING = 0.45
_TONE = tone_table()


def focus_blur(image: FloatImage, lengths: Array, defocus_px: float) -> FloatImage:
    """The image (h, w, 3) with defocus blur: ``defocus_px`` at half the focal distance."""
    if defocus_px <= 0.0:
        return image
    off = np.abs(FOCAL_DISTANCE / np.nan_to_num(lengths, nan=1.0) - 1.0)
    sigma = np.minimum(defocus_px * off, 6.0).astype(np.float32)
    sigma = cv2.GaussianBlur(sigma, (0, 0), 2.0)
    steps = (0.0, 1.5, 3.0, 6.0)
    result = image * np.clip(1.0 - sigma / steps[1], 0.0, 1.0)[..., None]
    for below, step, above in zip(steps[:-1], steps[1:], (*steps[2:], 12.0), strict=True):
        if sigma.max() <= below:
            break
        weight = np.clip(
            np.minimum((sigma - below) / (step - below), (above - sigma) / (above - step)), 0.0, 1.0
        )
        result += weight[..., None] * cv2.GaussianBlur(image, (0, 0), step)
    return np.asarray(result, dtype=np.float32)


def motion_blur(image: FloatImage, shift_px: Array) -> FloatImage:
    """The image (h, w, 3) with motion blur: a shift (2,) [px] while the shutter is open."""
    length = float(np.hypot(*shift_px))
    if length < 0.5:
        return image
    shift = shift_px * min(1.0, 40.0 / length)
    size = 2 * int(np.ceil(np.abs(shift).max() / 2.0)) + 3
    kernel = np.zeros((size, size), np.float32)
    for share in np.linspace(-0.5, 0.5, 4 * size + 1):
        x, y = share * shift + size // 2
        column, row = int(x), int(y)
        a, b = x - column, y - row
        patch = np.outer([1.0 - b, b], [1.0 - a, a]).astype(np.float32)
        kernel[row : row + 2, column : column + 2] += patch
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.float32)


class CameraHead:
    """Converts linear light to display images, frame by frame."""

    def __init__(
        self,
        conditions: Conditions,
        stop: FloatImage,
        radius: npt.NDArray[np.float32],
        seed: int,
        *,
        target: float = 0.50,
        tone: ByteImage = _TONE,
        sharpening: float = _SHARPENING,
    ) -> None:
        """``stop`` (h, w) is the field stop, ``radius`` (h, w) the distance from its centre, 1 at its rim.

        ``target`` is the mean display brightness, ``tone`` (4096,) the display values of light in [0, 2).
        """
        self._conditions, self._seed = conditions, seed
        self._stop = stop
        self._vignette = (1.0 - conditions.vignette * np.clip(radius, 0.0, 1.0) ** 2.5).astype(np.float32)
        self._tone, self._sharpening = tone, sharpening
        self._exposure = AutoExposure(Sensor(target=target, settle_s=conditions.exposure_lag_s))

    def develop(self, light: FloatImage, frame: int, step_s: float) -> ByteImage:
        """Display image (h, w, 3) bgr8 of linear light (h, w, 3)."""
        conditions = self._conditions
        falloff = self._vignette * self._stop
        gain = self._exposure.gain(light * self._vignette[..., None], self._stop, step_s)
        exposed = cv2.GaussianBlur(light, (0, 0), conditions.softness_px) * np.float32(gain)
        if conditions.bloom > 0.0:
            exposed += conditions.bloom * _bloom(exposed)
        exposed *= falloff[..., None]
        rng = np.random.default_rng([self._seed, 0x4E4F, frame])
        # Gain amplifies the noise of the light with it.
        amplified = float(np.clip(gain, 0.5, 6.0))
        variance = conditions.shot_noise**2 * amplified * exposed + (conditions.read_noise * amplified) ** 2
        noise = rng.standard_normal(exposed.shape, dtype=np.float32)
        exposed += (
            (noise + 0.6 * noise.mean(axis=-1, keepdims=True))
            * np.sqrt(np.maximum(variance, 0.0))
            * (self._stop[..., None] > 0.0)
        )
        display = self._tone[np.clip(exposed * 2048.0, 0.0, 4095.0).astype(np.uint16)]
        soft = cv2.GaussianBlur(display, (0, 0), 1.6)
        return np.asarray(cv2.addWeighted(display, 1.0 + self._sharpening, soft, -self._sharpening, 0.0))


def _bloom(exposed: FloatImage) -> FloatImage:
    """Light that spills from overexposed pixels, computed at a quarter of the size."""
    small = cv2.resize(exposed, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    excess = np.clip(small - 0.8, 0.0, 4.0)
    spilt = cv2.GaussianBlur(excess, (0, 0), 3.0) + 0.6 * cv2.GaussianBlur(excess, (0, 0), 12.0)
    return np.asarray(
        cv2.resize(spilt, exposed.shape[1::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )
