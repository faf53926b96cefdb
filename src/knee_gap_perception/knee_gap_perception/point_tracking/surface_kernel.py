"""The pixel loops that make texture and weight out of a crop, compiled."""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Float32, Image

SPARSE = 4  # [px] between the pixels that a median is taken of


def _tissue(smooth: Float32, valid: Image, dark_below: float, glare: float) -> Image:
    """1 where a smoothed crop (h, w) shows tissue: valid, brighter than the gap and darker than glare."""
    found = np.zeros(smooth.shape, np.uint8)
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            if valid[i, j] and smooth[i, j] > dark_below and smooth[i, j] < glare:
                found[i, j] = 1
    return found


def _details(
    smooth: Float32, surface: Float32, total: Float32, count: Float32, offset: float
) -> tuple[Float32, Float32, Float32]:
    """Local mean, detail against it, and the detail's square, each (h, w).

    `total` and `count` are sums over the local window: of the brightness of the surface, and of its pixels.
    """
    mean, detail, power = np.empty_like(smooth), np.empty_like(smooth), np.empty_like(smooth)
    one = np.float32(1.0)
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            level = total[i, j] / max(count[i, j], one)
            value = surface[i, j] * (smooth[i, j] - level) / (level + np.float32(offset))
            mean[i, j], detail[i, j], power[i, j] = level, value, value * value
    return mean, detail, power


def _median_on_surface(values: Float32, surface: Float32) -> float:
    """Median size of the values (h, w) on the surface; 0 if there is none."""
    sparse = np.empty(values.size, np.float32)
    count = 0
    for i in range(0, values.shape[0], SPARSE):
        for j in range(0, values.shape[1], SPARSE):
            if surface[i, j] > 0:
                sparse[count] = abs(values[i, j])
                count += 1
    return float(np.median(sparse[:count])) if count else 0.0


def _textures(
    smooth: Float32,
    mean: Float32,
    detail: Float32,
    power: Float32,
    count: Float32,
    clear: Image,
    level: float,
    faint: float,
    window: float,
    limits: tuple[float, float, float, float],
) -> tuple[Float32, Float32]:
    """Texture and weight (h, w).

    `power` is the sum of squared details over a local window of `window` pixels, `clear` is 1 where the
    surface is free of specks. `limits`: brightness against the tissue around from which a pixel is a
    highlight, the same against its window, and the shares of the window from no weight to full.
    """
    zero, one, tenth = np.float32(0.0), np.float32(1.0), np.float32(0.1)
    highlight, sparkle = np.float32(limits[0]), np.float32(limits[1])
    one_sided, steepness = np.float32(limits[2]), np.float32(1.0 / (limits[3] - limits[2]))
    per_window, per_level = np.float32(1.0 / window), np.float32(1.0 / max(level, 1.0))
    added = np.float32(faint)
    texture, weight = np.empty_like(smooth), np.empty_like(smooth)
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            strength = np.sqrt(max(power[i, j], zero) / max(count[i, j], one))
            texture[i, j] = detail[i, j] / (strength + added)
            sided = min(max((count[i, j] * per_window - one_sided) * steepness, zero), one)
            lit = (mean[i, j] * per_level - highlight) * np.float32(1.0 / 0.3)
            bright = (smooth[i, j] / max(mean[i, j], one) - sparkle) * np.float32(1.0 / 0.15)
            kept = one - min(max(max(lit, bright), zero), one)
            weight[i, j] = np.float32(clear[i, j]) * sided * (tenth + (one - tenth) * kept)
    return texture, weight


def _roughness(crop: Image, surface: Float32) -> float:
    """Mean size of the second differences along both axes, in the middle of a crop (h, w), on the surface."""
    height, width = crop.shape
    total, count = 0.0, 0
    for i in range(height // 4, height - -(-height // 4)):
        for j in range(width // 4, width - -(-width // 4)):
            if surface[i, j] > 0:
                rough = 4 * np.int64(crop[i, j])
                for k in (-1, 1):
                    rough -= 2 * (np.int64(crop[i + k, j]) + np.int64(crop[i, j + k]))
                    rough += np.int64(crop[i + k, j - 1]) + np.int64(crop[i + k, j + 1])
                total += float(abs(rough))
                count += 1
    return total / count if count else 0.0


# No fast arithmetic: the same pixels must give the same bits.
tissue: Callable[[Float32, Image, float, float], Image] = compiled(_tissue)
details: Callable[[Float32, Float32, Float32, Float32, float], tuple[Float32, Float32, Float32]] = compiled(
    _details
)
median_on_surface: Callable[[Float32, Float32], float] = compiled(_median_on_surface)
textures: Callable[
    [
        Float32,
        Float32,
        Float32,
        Float32,
        Float32,
        Image,
        float,
        float,
        float,
        tuple[float, float, float, float],
    ],
    tuple[Float32, Float32],
] = compiled(_textures)
roughness: Callable[[Image, Float32], float] = compiled(_roughness)
