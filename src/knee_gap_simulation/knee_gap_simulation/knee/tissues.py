"""Textures of the tissues of the knee."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from knee_gap_simulation.surfaces.textures import FloatImage, Tissue, tissue_texture

# In the order of the surfaces of `knee_field`.
_CONDYLE = Tissue((240, 230, 214), (232, 198, 168), 0.40, 0.06, 0.035, 0.02, relief=0.030, vessels=2)
_PLATEAU = Tissue((236, 222, 200), (228, 188, 156), 0.45, 0.07, 0.04, 0.03, relief=0.040, vessels=2)
_MENISCUS = Tissue((236, 216, 188), (226, 164, 136), 0.45, 0.06, 0.03, 0.055, relief=0.055, vessels=5)
_SYNOVIUM = Tissue((132, 54, 42), (84, 24, 20), 0.75, 0.22, 0.16, relief=0.16, gloss=0.5, vessels=22)
_STEEL = Tissue((92, 92, 92), (64, 62, 62), 0.5, 0.02, 0.03, 0.06, relief=0.012, gloss=6.0)


@lru_cache(maxsize=4)
def knee_textures(seed: int, contrast: float) -> FloatImage:
    """Textures (5, size, size, channels) of condyle, plateau, meniscus, capsule and probe.

    ``contrast`` in (0, 1] scales the detail of cartilage and meniscus: 1 is rich, 0.3 nearly uniform.
    """
    rng = np.random.default_rng([seed, 0x4B54])
    layers = []
    for tissue in (_CONDYLE, _PLATEAU, _MENISCUS, _SYNOVIUM, _STEEL):
        if tissue in (_CONDYLE, _PLATEAU, _MENISCUS):
            tissue = replace(
                tissue,
                mottle=contrast * tissue.mottle,
                grain=contrast * tissue.grain,
                fibres=contrast * tissue.fibres,
                relief=(0.5 + 0.5 * contrast) * tissue.relief,
                vessels=round(contrast * tissue.vessels),
                vessel_colour=(188, 96, 84),
            )
        layers.append(tissue_texture(tissue, rng))
    result = np.stack(layers)
    result.setflags(write=False)
    return result
