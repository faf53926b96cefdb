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
from knee_gap_perception.point_tracking.patch_kernel import normal_equations, reweighted, structures

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
GAIN_PRIOR = 0.3  # [-] standard deviation of the contrast against the patch's
NOISE_CORRELATION = 2.7  # factor on the variance: the residuals of neighbouring pixels are not independent
MAXIMUM_ITERATIONS = 12
CONVERGED = 0.02  # [px]
FINISHING = 2  # iterations in which only gradients count that both textures have
BLOCKS = 3  # a side, in which that is told apart
CHANCE = 0.1  # [-] share of them, and correlation, that two textures of mere noise have in common
LEAST_LIKENESS = 0.02  # [-] of textures that have nothing in common


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
        # Neighbours tell nearly the same: every other pixel of every other line costs no accuracy.
        sparse = (np.indices((side, side)) % 2 == 0).all(axis=0)
        self._pixels = np.stack([self.texture, dx, dy, self.weight * sparse], axis=-1).astype(np.float32)

    def find(self, surface: Surface, start: Warp, prior: Array) -> Registration:
        """The patch in another image, from a predicted warp with the covariance (6, 6) of its parameters.

        The parameters are position x, y [px] and shape xx, xy, yx, yy [-].
        """
        # A step s of the patch changes the warp's parameters by -jacobian s.
        jacobian = np.zeros((6, 6))
        jacobian[:2, :2] = start.shape
        jacobian[2:, 2:] = np.kron(start.shape, np.eye(2))
        prior_information = np.zeros((7, 7))
        prior_information[:6, :6] = jacobian.T @ np.linalg.inv(prior) @ jacobian
        prior_information[6, 6] = 1.0 / GAIN_PRIOR**2
        warp, gain, deviation, converged = start, 1.0, np.zeros(7), False
        # Where the noise makes gradients, they pull as much as true ones but say nothing. Near the end the
        # true part of them is known, and only that counts.
        pixels, finishing = self._pixels, 0
        for turn in range(MAXIMUM_ITERATIONS):
            hessian, slope, statistics = self._look(pixels, surface, warp, gain)
            precision = _likeness(statistics[2]) / (NOISE_CORRELATION * statistics[0] ** 2)
            posterior = hessian * precision + prior_information
            step = np.linalg.solve(posterior, slope * precision - prior_information @ deviation)
            deviation += step
            gain = min(max(gain + float(step[6]), 0.3), 3.0)
            warp = _compose(warp, step[:6])
            still = (
                np.abs(step[:2]).max() < CONVERGED
                and np.abs(step[2:6]).max() * self.half_size < 5 * CONVERGED
            )
            if finishing == FINISHING or (finishing and still):
                converged = True
                break
            if finishing or still or turn >= MAXIMUM_ITERATIONS - 1 - FINISHING:
                finishing += 1
                pixels = self._agreed(surface, warp)
        covariance = jacobian @ np.linalg.inv(posterior)[:6, :6] @ jacobian.T
        statistics = self._look(self._pixels, surface, warp, gain)[2]
        return Registration(
            warp, (covariance + covariance.T) / 2, float(statistics[2]), float(statistics[1]), converged
        )

    def _agreed(self, surface: Surface, warp: Warp) -> Float32:
        """The patch's pixels with its gradients cut down to the part that the image has as well.

        Block by block: with H the structure tensor of the patch and C that of patch and image, a gradient g
        becomes C H^-1 g, with eigenvalues from 0 to 1. The information on a shift is then C H^-1 C, and what
        noise alone pulls to vanishes on the average (instrumental variables).
        """
        own, cross = structures(
            self._pixels, surface.texture, surface.weight, self._matrix(surface, warp), BLOCKS
        )
        trace = np.trace(own, axis1=2, axis2=3)[..., None, None]
        values, vectors = np.linalg.eigh(own + 1e-6 * (1.0 + trace) * np.eye(2))
        turned = np.swapaxes(vectors, -1, -2)
        root = (vectors * np.sqrt(values)[..., None, :]) @ turned
        inverse = (vectors / np.sqrt(values)[..., None, :]) @ turned
        shares, axes = np.linalg.eigh(inverse @ cross @ inverse)
        shares = np.clip((shares - CHANCE) / (1.0 - CHANCE), 0.0, 1.0)
        agreement = root @ ((axes * shares[..., None, :]) @ np.swapaxes(axes, -1, -2)) @ inverse
        return reweighted(self._pixels, agreement)

    def _look(self, pixels: Float32, surface: Surface, warp: Warp, gain: float) -> tuple[Array, Array, Array]:
        return normal_equations(pixels, surface.texture, surface.weight, self._matrix(surface, warp), gain)

    def _matrix(self, surface: Surface, warp: Warp) -> Array:
        """Matrix (2, 3) from a pixel of the patch (column, row) to one of the crop."""
        corner = warp.position - np.array(surface.origin) - self.half_size * warp.shape.sum(axis=1)
        return np.concatenate([warp.shape, corner[:, None]], axis=1)


def _likeness(correlation: float) -> float:
    """Share of the information on a shift that counts, of textures that correlate so.

    The noise of both textures makes gradients that say nothing, and may lock onto each other. Found on the
    simulated knee, where what registrations add to the error was told apart from what grows with the
    parallax: the variance goes as the inverse of the correlation beyond chance.
    """
    return min(max((correlation - CHANCE) / (1.0 - CHANCE), LEAST_LIKENESS), 1.0)


def _compose(warp: Warp, step: Array) -> Warp:
    """Warp o step^-1, the inverse compositional update; the shape changes by a third at most."""
    change = np.eye(2) + np.clip(step[2:].reshape(2, 2), -0.3, 0.3)
    inverse = np.linalg.inv(change)
    return Warp(warp.position - warp.shape @ inverse @ step[:2], warp.shape @ inverse)
