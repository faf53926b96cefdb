"""The inner loops of patch registration, compiled: passes over the pixels of a patch.

Neighbouring pixels are nearly the same: a patch holds every STEP-th pixel of every STEP-th line. Places in
it are counted in pixels all the same.
"""

from collections.abc import Callable

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array, Float32

STEP = 2  # [px] between the pixels of a patch that are looked at, at no loss of accuracy
SPREAD_BINS = 512  # of the histogram that gives the median of the residuals
SPREAD_LIMIT = 6.0  # [-] largest residual in it; textures have unit contrast
MINIMUM_SPREAD = 0.05  # [-]
ROBUST = 3.0  # standard deviations at which a residual counts for a quarter


def _sample(
    patch: Float32,
    texture: Float32,
    weight: Float32,
    matrix: Array,
    gain: float,
    residual: Float32,
    mass: Float32,
) -> None:
    """Fill `residual` and `mass` (n, n) for a warp (2, 3) from a pixel of the patch to one of the crop.

    `patch` (n, n, 4) holds texture, its derivative along x and y, and weight.
    """
    rows, columns = texture.shape
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            residual[i, j] = 0.0
            mass[i, j] = 0.0
            own = patch[i, j, 3]
            if own <= 0.0:
                continue
            x = matrix[0, 0] * (STEP * j) + matrix[0, 1] * (STEP * i) + matrix[0, 2]
            y = matrix[1, 0] * (STEP * j) + matrix[1, 1] * (STEP * i) + matrix[1, 2]
            if not (0.0 <= x < columns - 1 and 0.0 <= y < rows - 1):
                continue
            left, top = int(x), int(y)
            fx, fy = x - left, y - top
            a, b = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy)
            c, d = (1.0 - fx) * fy, fx * fy
            seen = (
                a * weight[top, left]
                + b * weight[top, left + 1]
                + c * weight[top + 1, left]
                + d * weight[top + 1, left + 1]
            )
            value = (
                a * texture[top, left]
                + b * texture[top, left + 1]
                + c * texture[top + 1, left]
                + d * texture[top + 1, left + 1]
            )
            residual[i, j] = value - gain * patch[i, j, 0]
            mass[i, j] = own * seen


def _spread(residual: Float32, mass: Float32) -> float:
    """Robust standard deviation of the residuals: their median size, from a histogram, for a normal law."""
    counts = np.zeros(SPREAD_BINS)
    total = 0.0
    for i in range(residual.shape[0]):
        for j in range(residual.shape[1]):
            if mass[i, j] > 0.0:
                size = min(abs(residual[i, j]) / SPREAD_LIMIT, 0.999999)
                counts[int(size * SPREAD_BINS)] += mass[i, j]
                total += mass[i, j]
    if total <= 0.0:
        return 1.0
    below = 0.0
    for k in range(SPREAD_BINS):
        if below + counts[k] >= 0.5 * total:
            place = (k + (0.5 * total - below) / counts[k]) * SPREAD_LIMIT / SPREAD_BINS
            return float(max(1.4826 * place, MINIMUM_SPREAD))
        below += counts[k]
    return 1.0


def _normal_equations(
    patch: Float32, texture: Float32, weight: Float32, matrix: Array, gain: float
) -> tuple[Array, Array, Array]:
    """Hessian (7, 7) and slope (7,) of the robust squares, and what there was to see (4,).

    Parameters: shift x, y, shape xx, xy, yx, yy, gain. Seen were: the spread of the residuals, the share of
    the patch that is surface, the correlation of the textures, and the share that keeps its robust weight.
    """
    n = patch.shape[0]
    half = STEP * (n - 1) // 2
    residual = np.empty((n, n), np.float32)
    mass = np.empty((n, n), np.float32)
    sample(patch, texture, weight, matrix, gain, residual, mass)
    noise = spread(residual, mass)
    hessian, slope, column = np.zeros((7, 7)), np.zeros(7), np.zeros(7)
    seen = whole = kept = 0.0
    sum_a = sum_b = sum_aa = sum_bb = sum_ab = 0.0
    for i in range(n):
        for j in range(n):
            whole += patch[i, j, 3]
            m = mass[i, j]
            if m <= 0.0:
                continue
            seen += m
            r = residual[i, j]
            share = r / (ROBUST * noise)
            w = m / (1.0 + share * share) ** 2
            kept += w
            t, dx, dy = patch[i, j, 0], patch[i, j, 1], patch[i, j, 2]
            qx, qy = STEP * j - half, STEP * i - half
            column[0], column[1] = dx, dy
            column[2], column[3] = dx * qx, dx * qy
            column[4], column[5] = dy * qx, dy * qy
            column[6] = t
            for k in range(7):
                weighted = w * column[k]
                slope[k] += weighted * r
                for other in range(k, 7):
                    hessian[k, other] += weighted * column[other]
            value = r + gain * t
            sum_a += w * t
            sum_b += w * value
            sum_aa += w * t * t
            sum_bb += w * value * value
            sum_ab += w * t * value
    for k in range(7):
        for other in range(k):
            hessian[k, other] = hessian[other, k]
    statistics = np.array([noise, 0.0, 0.0, 0.0])
    if whole > 0.0 and kept > 0.0:
        statistics[1] = seen / whole
        statistics[3] = kept / whole
        power = (sum_aa - sum_a * sum_a / kept) * (sum_bb - sum_b * sum_b / kept)
        if power > 0.0:
            statistics[2] = (sum_ab - sum_a * sum_b / kept) / np.sqrt(power)
    return hessian, slope, statistics


def _bilinear(texture: Float32, x: float, y: float) -> float:
    """Texture at a place inside it."""
    left, top = int(x), int(y)
    fx, fy = x - left, y - top
    upper = (1.0 - fx) * texture[top, left] + fx * texture[top, left + 1]
    lower = (1.0 - fx) * texture[top + 1, left] + fx * texture[top + 1, left + 1]
    return float((1.0 - fy) * upper + fy * lower)


def _structures(
    patch: Float32, texture: Float32, weight: Float32, matrix: Array, blocks: int
) -> tuple[Array, Array]:
    """Structure tensors (blocks, blocks, 2, 2): of the patch's gradients, and of them with the image's.

    The image's are drawn as the patch. Noise is in the first, and in the second on the average only once in
    a product, so not at all.
    """
    rows, columns = texture.shape
    side = STEP * (patch.shape[0] - 1) + 1
    owns, crosses = np.zeros((blocks, blocks, 2, 2)), np.zeros((blocks, blocks, 2, 2))
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            share = patch[i, j, 3]
            if share <= 0.0:
                continue
            x = matrix[0, 0] * (STEP * j) + matrix[0, 1] * (STEP * i) + matrix[0, 2]
            y = matrix[1, 0] * (STEP * j) + matrix[1, 1] * (STEP * i) + matrix[1, 2]
            reach_x = abs(matrix[0, 0]) + abs(matrix[0, 1])
            reach_y = abs(matrix[1, 0]) + abs(matrix[1, 1])
            if not (reach_x <= x < columns - 1 - reach_x and reach_y <= y < rows - 1 - reach_y):
                continue
            m = share * weight[int(y + 0.5), int(x + 0.5)]
            if m <= 0.0:
                continue
            ahead = bilinear(texture, x + matrix[0, 0], y + matrix[1, 0])
            behind = bilinear(texture, x - matrix[0, 0], y - matrix[1, 0])
            below = bilinear(texture, x + matrix[0, 1], y + matrix[1, 1])
            above = bilinear(texture, x - matrix[0, 1], y - matrix[1, 1])
            gx, gy = 0.5 * (ahead - behind), 0.5 * (below - above)
            dx, dy = patch[i, j, 1], patch[i, j, 2]
            block = (STEP * i * blocks // side, STEP * j * blocks // side)
            own, cross = owns[block], crosses[block]
            own[0, 0] += m * dx * dx
            own[0, 1] += m * dx * dy
            own[1, 1] += m * dy * dy
            cross[0, 0] += m * dx * gx
            cross[0, 1] += 0.5 * m * (dx * gy + dy * gx)
            cross[1, 1] += m * dy * gy
    owns[:, :, 1, 0], crosses[:, :, 1, 0] = owns[:, :, 0, 1], crosses[:, :, 0, 1]
    return owns, crosses


def _reweighted(patch: Float32, change: Array) -> Float32:
    """The patch (n, n, 4), the gradients of each block multiplied by a matrix (blocks, blocks, 2, 2)."""
    blocks = change.shape[0]
    side = STEP * (patch.shape[0] - 1) + 1
    changed = patch.copy()
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            if patch[i, j, 3] <= 0.0:
                continue
            matrix = change[STEP * i * blocks // side, STEP * j * blocks // side]
            dx, dy = patch[i, j, 1], patch[i, j, 2]
            changed[i, j, 1] = matrix[0, 0] * dx + matrix[0, 1] * dy
            changed[i, j, 2] = matrix[1, 0] * dx + matrix[1, 1] * dy
    return changed


def _block_tensors(
    dx: Float32,
    dy: Float32,
    weight: Float32,
    window: Float32,
    corner: tuple[int, int],
    step: int,
    blocks: int,
) -> tuple[Array, float]:
    """Structure tensors (blocks^2, 3) as xx, xy, yy of a square of gradients (h, w), and its weight.

    `corner` is its first row and column; every `step`-th pixel is looked at, each with its share of the
    `window` (n, n).
    """
    tensors, total = np.zeros((blocks * blocks, 3)), 0.0
    n = window.shape[0]
    for i in range(n):
        row = corner[0] + step * i
        for j in range(n):
            column = corner[1] + step * j
            share = window[i, j] * weight[row, column]
            total += share
            gx, gy = dx[row, column], dy[row, column]
            block = tensors[(i * blocks // n) * blocks + j * blocks // n]
            block[0] += share * gx * gx
            block[1] += share * gx * gy
            block[2] += share * gy * gy
    return tensors, total


# No fast arithmetic: the same pixels must give the same bits.
sample = compiled(_sample)
spread = compiled(_spread)
normal_equations: Callable[[Float32, Float32, Float32, Array, float], tuple[Array, Array, Array]] = compiled(
    _normal_equations
)
bilinear = compiled(_bilinear)
structures: Callable[[Float32, Float32, Float32, Array, int], tuple[Array, Array]] = compiled(_structures)
reweighted: Callable[[Float32, Array], Float32] = compiled(_reweighted)
block_tensors: Callable[
    [Float32, Float32, Float32, Float32, tuple[int, int], int, int], tuple[Array, float]
] = compiled(_block_tensors)
