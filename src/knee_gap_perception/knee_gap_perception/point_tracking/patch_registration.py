"""Registration of a small piece of surface from one image to another, by its texture.

A patch is taken around a point of the surface, without its shading: brightness is taken against its local
mean and contrast, so that a light that moves, its highlights and an exposure that adapts change little.
Pixels that are not the surface (the gap, glare, the surround) have no weight. The patch is then found in
another image under an affine warp pixel = position + shape q, q [px] counted from the point in the patch,
by Gauss-Newton on the weighted squares (inverse compositional: Baker and Matthews 2004), held to a
prediction by priors on position and shape.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array, Float32, Image
from knee_gap_perception.point_tracking.patch_fit import fit_patch, placement
from knee_gap_perception.point_tracking.patch_kernel import STEP
from knee_gap_perception.point_tracking.surface_kernel import (
    details,
    median_on_surface,
    roughness,
    textures,
    tissue,
)

LOCAL_MEAN = 25  # [px] side of the window of the local mean and contrast
ONE_SIDED, FULL_SIDED = 0.75, 0.97  # share of that window on the surface: from no weight to full
SMOOTHING = 1.8  # [px] standard deviation: what is finer is noise
FAINT = 0.004  # [-] contrast of detail added to the local one, if there is none
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

    @property
    def parameters(self) -> Array:
        """Position x, y and shape xx, xy, yx, yy (6,)."""
        return np.concatenate([self.position, self.shape.reshape(-1)])


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
    smooth = np.asarray(cv2.GaussianBlur(crop.astype(np.float32), (0, 0), SMOOTHING), np.float32)
    found = tissue(smooth, valid, float(dark_below), float(GLARE))
    # Outside the crop counts as no surface.
    surface = cv2.erode(found, np.ones((5, 5), np.uint8), borderValue=[0.0]).astype(np.float32)
    window = (_odd(LOCAL_MEAN * stretch[0]), _odd(LOCAL_MEAN * stretch[1]))
    total, count = _window_sum(smooth * surface, window), _window_sum(surface, window)
    mean, detail, square = details(smooth, surface, total, count, DARK_OFFSET)
    level = median_on_surface(mean, surface)
    # Shreds that drift by are pale and near the lamp. One of them on smooth cartilage would be all the
    # texture there is, and carry the patch away.
    usual = max(median_on_surface(detail, surface), FAINT)
    specks = (detail > SPECK * usual).astype(np.uint8)
    clear = (surface > cv2.dilate(specks, np.ones((SPECK_RIM, SPECK_RIM), np.uint8))).astype(np.uint8)
    # Noise of the pixels of the surface (Immerkaer 1996): the middle of the crop is enough.
    noise = float(np.sqrt(np.pi / 2) / 6) * roughness(crop, surface)
    texture, weight = textures(
        smooth,
        mean,
        detail,
        _window_sum(square, window),
        count,
        clear,
        level,
        FAINT + NOISE_SHARE * noise / (level + DARK_OFFSET),
        float(window[0] * window[1]),
        # A highlight is brighter than the tissue around it and moves with the lamp. Beside an edge the window
        # is one-sided: the shading towards a contour would pass for texture, and slide.
        (HIGHLIGHT, SPARKLE, ONE_SIDED, FULL_SIDED),
    )
    return Surface(texture, weight, (column, row))


def _window_sum(values: Float32, window: tuple[int, int]) -> Float32:
    """Sum (h, w) over the window around each pixel; nothing outside."""
    summed = cv2.boxFilter(values, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32)


def _odd(size: float) -> int:
    """The odd number next to a size."""
    return 2 * max(1, round((size - 1) / 2)) + 1


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
