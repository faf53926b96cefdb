"""Difficulty of a simulated image: a level from 0 (easy) to 3 for each cause."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from knee_gap_simulation.errors import SimulationError

LEVELS = (0, 1, 2, 3)


@dataclass(frozen=True)
class Difficulty:
    """Level 0-3 of each difficulty.

    texture: uniformity of the cartilage. relief: unevenness of bone and rim, and fraying. glare: specular
    reflections and their bloom. light: vignette, narrow beam, slow exposure. motion: tremor and motion blur.
    focus: softness of the lens and defocus. turbidity: absorption, veil and wisps of blood. debris: drifting
    shreds. probe: a probe that covers an edge. noise: sensor noise and JPEG.
    """

    texture: int = 0
    relief: int = 0
    glare: int = 0
    light: int = 0
    motion: int = 0
    focus: int = 0
    turbidity: int = 0
    debris: int = 0
    probe: int = 0
    noise: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            if getattr(self, field.name) not in LEVELS:
                raise SimulationError(
                    f"the level of {field.name} must be 0, 1, 2 or 3, not {getattr(self, field.name)}"
                )

    @staticmethod
    def at(level: int, but: Mapping[str, int] | None = None) -> "Difficulty":
        """All difficulties at one level, except those given by name."""
        names = [field.name for field in fields(Difficulty)]
        if unknown := sorted(set(but or {}) - set(names)):
            raise SimulationError(f"there is no difficulty '{unknown[0]}'; there are {', '.join(names)}")
        return replace(Difficulty(**dict.fromkeys(names, level)), **(but or {}))


@dataclass(frozen=True)
class Conditions:
    """Numbers behind a difficulty. Lengths [m], times [s], angles [rad]; ``_px`` in pixels."""

    # tissue
    contrast: float  # of the cartilage's texture, 1 = rich
    roughness: float  # of surfaces and rims
    # light
    glare: float
    bloom: float
    vignette: float  # fraction of the light lost at the rim of the image
    beam: float  # exponent of the lamp's fall-off to the side
    exposure_lag_s: float
    # hand and optics
    tremor: float
    shutter_s: float
    softness_px: float
    defocus_px: float  # blur at half the focal distance and at infinity
    # fluid
    absorption: float  # [1/m]
    veil: float
    wisps: float
    debris: int
    # probe
    probe_visits: tuple[tuple[float, float], ...]  # from, to, within every PROBE_PERIOD_S
    # camera head
    shot_noise: float
    read_noise: float
    jpeg_quality: int


PROBE_PERIOD_S = 4.0


def conditions(difficulty: Difficulty) -> Conditions:
    """Numbers behind the levels; each increases with its own level only."""
    visits: tuple[tuple[tuple[float, float], ...], ...] = (
        (),
        ((1.9, 2.6),),
        ((1.4, 2.5),),
        ((0.9, 1.9), (2.7, 3.6)),
    )
    return Conditions(
        contrast=(1.0, 0.7, 0.45, 0.28)[difficulty.texture],
        roughness=(0.4, 0.8, 1.0, 1.3)[difficulty.relief],
        glare=(0.25, 0.6, 0.9, 1.3)[difficulty.glare],
        bloom=(0.0, 0.04, 0.08, 0.14)[difficulty.glare],
        vignette=(0.10, 0.25, 0.40, 0.50)[difficulty.light],
        beam=(1.0, 1.5, 2.2, 3.0)[difficulty.light],
        exposure_lag_s=(0.05, 0.15, 0.30, 0.50)[difficulty.light],
        tremor=(0.02e-3, 0.04e-3, 0.06e-3, 0.09e-3)[difficulty.motion],
        shutter_s=(1 / 500, 1 / 250, 1 / 120, 1 / 70)[difficulty.motion],
        softness_px=(0.8, 1.0, 1.3, 1.7)[difficulty.focus],
        defocus_px=(0.0, 0.8, 1.6, 2.6)[difficulty.focus],
        absorption=(4.0, 9.0, 16.0, 26.0)[difficulty.turbidity],
        veil=(0.0, 0.015, 0.035, 0.07)[difficulty.turbidity],
        wisps=(0.0, 0.08, 0.20, 0.38)[difficulty.turbidity],
        debris=(0, 6, 18, 40)[difficulty.debris],
        probe_visits=visits[difficulty.probe],
        shot_noise=(0.003, 0.007, 0.012, 0.020)[difficulty.noise],
        read_noise=(0.0005, 0.0010, 0.0018, 0.0030)[difficulty.noise],
        jpeg_quality=(93, 88, 80, 68)[difficulty.noise],
    )
