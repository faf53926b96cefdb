"""Textures of the tissues of a look: neutral smooth cartilage, red synovium, instruments of every finish."""

from functools import lru_cache

import numpy as np

from knee_gap_simulation.looks.look import Tissues, shared_rng
from knee_gap_simulation.surfaces.textures import (
    FloatImage,
    Tissue,
    band_noise,
    linear_from_srgb,
    tissue_texture,
)

_BLOOD = (176, 28, 24)


@lru_cache(maxsize=4)
def look_textures(seed: int, tissues: Tissues) -> FloatImage:
    """Textures (5, size, size, channels) of condyle, plateau, meniscus, capsule and instrument."""
    rng = shared_rng(seed, 1)
    pink = (232, 178, 160)
    mottle, grain, relief = tissues.mottle, tissues.grain, tissues.relief
    kinds = (
        Tissue(tissues.condyle, pink, 0.25 * tissues.blush, mottle, grain, relief=relief),
        Tissue(tissues.plateau, pink, 0.35 * tissues.blush, 1.8 * mottle, 1.5 * grain, relief=1.6 * relief),
        Tissue(
            tissues.meniscus,
            pink,
            tissues.blush,
            1.8 * mottle,
            1.5 * grain,
            tissues.fibres,
            relief=1.8 * relief,
            vessels=tissues.meniscus_vessels,
            vessel_colour=(200, 96, 88),
        ),
        Tissue(
            tissues.wall,
            tissues.wall_blush,
            0.7,
            tissues.wall_mottle,
            0.25 * tissues.wall_mottle,
            relief=tissues.wall_relief,
            gloss=0.7,
            vessels=tissues.wall_vessels,
            vessel_colour=(160, 44, 44),
        ),
        Tissue(
            tissues.instrument,
            tissues.instrument,
            0.0,
            0.03,
            0.02,
            0.05,
            relief=0.010,
            gloss=tissues.instrument_gloss,
        ),
    )
    layers = [tissue_texture(kind, rng) for kind in kinds]
    if tissues.bleeding > 0.0:
        for layer in layers[1:4]:
            _bleed(layer, tissues.bleeding, rng)
    result = np.stack(layers)
    result.setflags(write=False)
    return result


def _bleed(layer: FloatImage, share: float, rng: np.random.Generator) -> None:
    """Stain a texture with patches of blood."""
    patches = np.clip(1.5 * (band_noise(rng, (1.0, 9.0), stretch=2.0) - 1.9 + 1.1 * share), 0.0, 1.0)
    cover = (0.85 * patches)[..., None].astype(np.float32)
    blood = linear_from_srgb(_BLOOD)[::-1].astype(np.float32)
    layer[..., :3] = (1.0 - cover) * layer[..., :3] + cover * blood
