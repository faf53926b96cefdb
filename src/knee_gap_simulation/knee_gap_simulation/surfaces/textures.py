"""Textures of tissue: periodic colour, fine relief and gloss, made from seeded noise."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

FloatImage = npt.NDArray[np.float32]

SIZE_PX = 1024
PERIOD = 0.024  # side of a tile [m]

# Channels of a texture: blue, green, red albedo (linear), slope of the relief along u and along v, gloss.
CHANNELS = 6


@dataclass(frozen=True)
class Tissue:
    """Appearance of one kind of tissue.

    Colours are sRGB (red, green, blue) in [0, 255]. ``mottle`` (0.5-3 mm), ``grain`` (0.1-0.4 mm) and
    ``fibres`` (streaks along u) are the RMS of the relative change of brightness; ``relief`` is the RMS
    slope of the surface; ``vessels`` counts the trees of vessels on a tile.
    """

    colour: tuple[int, int, int]
    blush: tuple[int, int, int]
    blush_share: float = 0.3
    mottle: float = 0.03
    grain: float = 0.02
    fibres: float = 0.0
    relief: float = 0.03
    gloss: float = 1.0
    vessels: int = 0
    vessel_colour: tuple[int, int, int] = (150, 40, 40)


def linear_from_srgb(colour: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Linear values in [0, 1] of sRGB values in [0, 255]."""
    value = np.asarray(colour, dtype=np.float64) / 255.0
    return np.asarray(np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))


def band_noise(
    rng: np.random.Generator,
    cycles: tuple[float, float],
    *,
    stretch: float = 1.0,
    slope: float = 1.0,
    size_px: int = SIZE_PX,
) -> FloatImage:
    """Periodic Gaussian noise (size, size) of zero mean and unit variance.

    Its spectrum lies between two numbers of ``cycles`` a tile, with amplitude falling as frequency^-slope.
    ``stretch`` > 1 draws it out along u (columns).
    """
    v = np.fft.fftfreq(size_px)[:, None] * size_px
    u = np.fft.rfftfreq(size_px)[None, :] * size_px
    frequency = np.hypot(u * np.sqrt(stretch), v / np.sqrt(stretch))
    band = np.exp(-0.5 * (frequency / cycles[1]) ** 4) - np.exp(-0.5 * (frequency / cycles[0]) ** 4)
    spectrum = np.fft.rfft2(rng.standard_normal((size_px, size_px))) * band
    field = np.fft.irfft2(spectrum / np.maximum(frequency, 1.0) ** slope, s=(size_px, size_px))
    return np.asarray(field / field.std(), dtype=np.float32)


def tissue_texture(tissue: Tissue, rng: np.random.Generator) -> FloatImage:
    """The texture (SIZE_PX, SIZE_PX, CHANNELS) of a tissue."""
    blush = tissue.blush_share * (0.5 + 0.5 * np.tanh(band_noise(rng, (1.0, 5.0))))[..., None]
    albedo = (1.0 - blush) * linear_from_srgb(tissue.colour) + blush * linear_from_srgb(tissue.blush)
    brightness = tissue.mottle * band_noise(rng, (8.0, 40.0)) + tissue.grain * band_noise(rng, (40.0, 220.0))
    if tissue.fibres > 0.0:
        brightness += tissue.fibres * band_noise(rng, (20.0, 220.0), stretch=9.0)
    albedo = albedo * np.exp(brightness)[..., None]
    if tissue.vessels > 0:
        veins = vessel_map(rng, tissue.vessels)[..., None]
        albedo = (1.0 - veins) * albedo + veins * linear_from_srgb(tissue.vessel_colour)
    relief = band_noise(rng, (6.0, 60.0), slope=1.5) + 0.15 * band_noise(rng, (60.0, 250.0))
    slope_u = np.roll(relief, -1, axis=1) - np.roll(relief, 1, axis=1)
    slope_v = np.roll(relief, -1, axis=0) - np.roll(relief, 1, axis=0)
    scale = tissue.relief / np.sqrt(np.mean(slope_u**2 + slope_v**2))
    gloss = tissue.gloss * np.exp(0.35 * band_noise(rng, (4.0, 60.0)))
    layers = [albedo[..., 2], albedo[..., 1], albedo[..., 0], scale * slope_u, scale * slope_v, gloss]
    return np.asarray(np.stack(layers, axis=-1), dtype=np.float32)


def vessel_map(rng: np.random.Generator, trees: int) -> npt.NDArray[np.float64]:
    """Cover (SIZE_PX, SIZE_PX) in [0, 1] of branching vessels, periodic."""
    canvas = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    for _ in range(trees):
        start = rng.uniform(0.0, SIZE_PX, 2)
        _grow(canvas, rng, start, rng.uniform(0.0, 2.0 * np.pi), width_px=rng.uniform(1.8, 3.6))
    tiled = cv2.GaussianBlur(np.tile(canvas, (3, 3)), (0, 0), 1.3)
    return np.asarray(tiled[SIZE_PX : 2 * SIZE_PX, SIZE_PX : 2 * SIZE_PX], dtype=np.float64) / 255.0


def _grow(
    canvas: npt.NDArray[np.uint8],
    rng: np.random.Generator,
    start: npt.NDArray[np.float64],
    heading: float,
    width_px: float,
) -> None:
    """Draw one vessel that winds, thins and branches, wrapped around the borders of the tile."""
    point = start
    while width_px > 0.9:
        heading += rng.normal(0.0, 0.22)
        following = point + 9.0 * np.array([np.cos(heading), np.sin(heading)])
        corner = np.floor(point / SIZE_PX) * SIZE_PX
        strength = int(np.clip(40.0 + 30.0 * width_px, 0.0, 190.0))
        for shift in ((0, 0), (SIZE_PX, 0), (-SIZE_PX, 0), (0, SIZE_PX), (0, -SIZE_PX)):
            ends = [np.round((p - corner + shift) * 8.0).astype(int) for p in (point, following)]
            cv2.line(
                canvas,
                (int(ends[0][0]), int(ends[0][1])),
                (int(ends[1][0]), int(ends[1][1])),
                (strength,),
                max(1, round(width_px)),
                cv2.LINE_AA,
                3,
            )
        point = following
        width_px *= 0.985
        if rng.random() < 0.05:
            side = rng.choice([-1.0, 1.0])
            _grow(
                canvas, rng, point, heading + side * rng.uniform(0.4, 1.0), width_px * rng.uniform(0.5, 0.75)
            )
