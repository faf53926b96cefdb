"""Registration of a small piece of surface from one image to another, by its texture.

A patch is taken around a point of the surface, without its shading: brightness is taken against its local
mean and contrast, so that a light that moves, its highlights and an exposure that adapts change little.
Pixels that are not the surface (the gap, glare, the surround) have no weight. The patch is then found in
another image under an affine warp pixel = position + shape q, q [px] counted from the point in the patch,
by Gauss-Newton on the weighted squares (inverse compositional: Baker and Matthews 2004), held to a
prediction by priors on position and shape.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Float32, Image
from knee_gap_perception.point_tracking.patch_fit import fit_patch, placement
from knee_gap_perception.point_tracking.patch_kernel import STEP

LOCAL_MEAN = 25  # [px] side of the window of the local mean and contrast
ONE_SIDED, FULL_SIDED = 0.75, 0.97  # share of that window on the surface: from no weight to full
SMOOTHING = 1.8  # [px] standard deviation: what is finer is noise
FAINT = 0.004  # [-] contrast of detail added to the local one, where there is none
NOISE_SHARE = 0.6  # of the pixels' noise added as well: noise must not look like texture
DARK_OFFSET = 8.0  # [grey levels] added to the local mean: noise must not be blown up in the dark
HIGHLIGHT = 1.15  # brightness against the tissue around from which a pixel loses weight
SPARKLE = 1.12  # the same for a pixel against its window: small highlights
SPECK = 6.0  # times the usual detail of a surface, from which something bright is not of it
SPECK_RIM = 7  # [px] side of what is left out around each of its pixels
GLARE = 246  # [grey levels] above which a pixel shows the lamp
WINDOW = 0.55  # [-] standard deviation of a patch's weight, against its half side


@dataclass(frozen=True)
class Surface:
    """Texture (h, w) [-] and weight (h, w) in [0, 1] of a crop whose first pixel is `origin`."""

    texture: Float32
    weight: Float32
    origin: tuple[int, int]


@dataclass(frozen=True)
class Warp:
    """pixel = position (2,) [px] + shape (2, 2) q."""

    position: Array
    shape: Array


@dataclass(frozen=True)
class Registration:
    """Where a patch was found.

    `covariance` (6, 6) is that of position x, y [px] and shape xx, xy, yx, yy, from the image's noise and
    the prior; `correlation` [-1, 1] is that of the textures, `seen` the share [0, 1] of the patch that was
    the surface.
    """

    warp: Warp
    covariance: Array
    correlation: float
    seen: float
    converged: bool


def surface_around(
    grey: Image,
    centre: Array,
    half_size: int,
    dark_below: float,
    field_mask: npt.NDArray[np.bool_] | None = None,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> Surface:
    """Texture and weight of the square around a pixel of an image (h, w); none outside the image.

    `stretch` [-] is that of the window of the local mean and contrast, along columns and rows.
    """
    column, row = int(np.floor(centre[0])) - half_size, int(np.floor(centre[1])) - half_size
    side = 2 * half_size + 1
    crop = np.zeros((side, side), np.uint8)
    valid = np.zeros((side, side), np.uint8)
    top, left = max(0, row), max(0, column)
    bottom, right = min(grey.shape[0], row + side), min(grey.shape[1], column + side)
    if bottom > top and right > left:
        inner = np.s_[top - row : bottom - row, left - column : right - column]
        crop[inner] = grey[top:bottom, left:right]
        valid[inner] = 1 if field_mask is None else field_mask[top:bottom, left:right]
    raw = crop.astype(np.float32)
    smooth = cv2.GaussianBlur(raw, (0, 0), SMOOTHING)
    surface = valid * ((smooth > dark_below) & (smooth < GLARE))
    # Outside the crop counts as no surface.
    eroded = cv2.erode(surface.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=[0.0])
    surface = eroded.astype(np.float32)
    window = (_odd(LOCAL_MEAN * stretch[0]), _odd(LOCAL_MEAN * stretch[1]))
    total = cv2.boxFilter(smooth * surface, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(surface, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    mean = total / np.maximum(count, 1.0)
    detail = surface * (smooth - mean) / (mean + DARK_OFFSET)
    sparse = mean[::4, ::4][surface[::4, ::4] > 0]
    level = float(np.median(sparse)) if sparse.size else 0.0
    # A highlight is brighter than the tissue around it and moves with the lamp.
    highlight = np.clip((mean / max(level, 1.0) - HIGHLIGHT) / 0.3, 0.0, 1.0)
    power = cv2.boxFilter(detail * detail, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    strength = np.sqrt(np.maximum(power, 0.0) / np.maximum(count, 1.0))
    # Beside an edge the window is one-sided: the shading towards a contour would pass for texture, and slide.
    sided = np.clip((count / (window[0] * window[1]) - ONE_SIDED) / (FULL_SIDED - ONE_SIDED), 0.0, 1.0)
    sparkle = np.clip((smooth / np.maximum(mean, 1.0) - SPARKLE) / 0.15, 0.0, 1.0)
    clear = surface * _without_specks(detail, surface)
    weight = (clear * sided * (1.0 - 0.9 * np.maximum(highlight, sparkle))).astype(np.float32)
    faint = FAINT + NOISE_SHARE * _noise(raw, surface) / (level + DARK_OFFSET)
    return Surface(detail / (strength + faint), weight, (column, row))


def _without_specks(detail: Float32, surface: npt.NDArray[Any]) -> Float32:
    """Weight (h, w) that is 0 on and around what is far brighter than any detail of the surface usually is.

    Shreds that drift by are pale and near the lamp. One of them on smooth cartilage would be all the texture
    there is, and carry the patch away.
    """
    few = np.abs(detail[::4, ::4][surface[::4, ::4] > 0])
    usual = float(np.median(few)) if few.size else 0.0
    specks = (detail > SPECK * max(usual, FAINT)).astype(np.uint8)
    return np.asarray(1.0 - cv2.dilate(specks, np.ones((SPECK_RIM, SPECK_RIM), np.uint8)), np.float32)


def _odd(size: float) -> int:
    """The odd number next to a size."""
    return 2 * max(1, round((size - 1) / 2)) + 1


def _noise(raw: Float32, surface: npt.NDArray[Any]) -> float:
    """Standard deviation of the noise of the pixels of the surface (Immerkaer 1996)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    # The middle of the crop tells enough.
    middle = np.s_[raw.shape[0] // 4 : -raw.shape[0] // 4, raw.shape[1] // 4 : -raw.shape[1] // 4]
    rough = np.abs(cv2.filter2D(raw[middle], -1, kernel)[surface[middle] > 0])
    return float(np.sqrt(np.pi / 2) / 6 * rough.mean()) if rough.size else 0.0


def patch_window(half_size: int) -> Float32:
    """Weight of the places of a patch (n, n) of a half size [px]: most in its middle."""
    line = np.arange(-half_size, half_size + 1, dtype=np.float32)
    fall = np.exp(-(line**2) / (2 * (WINDOW * half_size) ** 2))
    return np.outer(fall, fall)


def gradients(texture: Float32) -> tuple[Float32, Float32]:
    """Derivatives of a texture (h, w) along x and y [1/px]."""
    dx, dy = (cv2.Sobel(texture, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return np.asarray(dx, np.float32), np.asarray(dy, np.float32)


class Patch:
    """A piece of surface around a point, ready to be found in other images."""

    def __init__(self, surface: Surface, position: Array, half_size: int) -> None:
        """Take the patch of side 2 half_size + 1 around a pixel (2,)."""
        self.half_size = half_size
        matrix = self._matrix(surface, Warp(position, np.eye(2)))
        side = 2 * half_size + 1
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        self.texture = cv2.warpAffine(surface.texture, matrix, (side, side), flags=flags).astype(np.float32)
        seen = cv2.warpAffine(surface.weight, matrix, (side, side), flags=flags)
        self.weight = (seen * patch_window(half_size)).astype(np.float32)
        dx, dy = gradients(self.texture)
        pixels = np.stack([self.texture, dx, dy, self.weight], axis=-1)[::STEP, ::STEP]
        self._pixels = np.ascontiguousarray(pixels, np.float32)

    def find(self, surface: Surface, start: Warp, prior: Array) -> Registration:
        """The patch in another image, from a predicted warp with the covariance (6, 6) of its parameters.

        The parameters are position x, y [px] and shape xx, xy, yx, yy [-].
        """
        position, shape, covariance, correlation, seen, converged = fit_patch(
            self._pixels,
            surface.texture,
            surface.weight,
            np.array(surface.origin, np.float64),
            np.array(start.position, np.float64),
            np.array(start.shape, np.float64, order="C"),
            np.array(prior, np.float64, order="C"),
        )
        return Registration(Warp(position, shape), covariance, correlation, seen, converged)

    def _matrix(self, surface: Surface, warp: Warp) -> Array:
        """Matrix (2, 3) from a pixel of the patch (column, row) to one of the crop."""
        origin = np.array(surface.origin, np.float64)
        return placement(warp.position, np.ascontiguousarray(warp.shape), origin, float(self.half_size))
