"""The look of a recording: everything that differs from scope to scope, lamp to lamp and knee to knee.

A look is drawn from a seed. It changes what the picture looks like, never where anything is, with two
exceptions that the ground truth knows: the lens (zoom, size, cut) and the shape of the joint's wall.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from knee_gap_core.values.arrays import Array
from knee_gap_simulation.knee.difficulty import Conditions
from knee_gap_simulation.knee.probe import HOOK, Probe, Rod
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.shading import Light

Colour = tuple[int, int, int]


class Appearance(StrEnum):
    """PLAIN: one warm, textured, evenly exposed look. REAL: drawn from the seed, as arthroscopes show it."""

    PLAIN = "plain"
    REAL = "real"


@dataclass(frozen=True)
class Head:
    """The camera head and its processor.

    ``colours`` (3, 3) maps linear blue green red to that of the display: white balance, cast, saturation.
    ``target`` is the mean display brightness; above ``shoulder`` (linear) highlights are compressed to white,
    1 clips them hard. ``black`` (linear) is subtracted, which swallows the shadows. ``fringe_px`` (3,) are
    the shifts of the field's rim in blue, green and red.
    """

    colours: Array
    target: float
    shoulder: float
    black: float
    sharpening: float
    bloom: float
    fringe_px: tuple[float, float, float]
    warmth: float
    softness: float


@dataclass(frozen=True)
class Border:
    """What surrounds the field: notch, surround, writing. Angles [rad] in the image, from x towards y.

    ``notch_height`` is a fraction of the field's radius, negative for a notch that points outwards; 0 for
    none. ``notch_light`` is the light of an outward notch relative to the rim.
    """

    notch_angle: float
    notch_height: float
    notch_half_width: float
    notch_light: float
    surround: Colour
    grain: float
    margin: bool
    lines: tuple[str, ...]
    labels: int


@dataclass(frozen=True)
class Tissues:
    """Colours (sRGB red, green, blue) and unevenness of the tissues, and the steel of the instrument."""

    condyle: Colour
    plateau: Colour
    meniscus: Colour
    wall: Colour
    wall_blush: Colour
    instrument: Colour
    blush: float
    mottle: float
    grain: float
    fibres: float
    relief: float
    wall_mottle: float
    wall_relief: float
    wall_vessels: int
    meniscus_vessels: int
    instrument_gloss: float
    bleeding: float


@dataclass(frozen=True)
class Clutter:
    """Numbers of things in front of the tissue; `bubbles`, `near` and strands cover what is behind them."""

    villi: int
    frays: int
    strands: int
    sutures: int
    bubbles: int
    fibres: int
    near: float


@dataclass(frozen=True)
class Look:
    """The look of one recording."""

    seed: int
    head: Head
    border: Border
    tissues: Tissues
    clutter: Clutter
    light: Light
    lens: Lens
    gap: float
    roll: float
    wall_behind: float
    wall_aside: float
    condyle_aside: float
    rim_bend: float
    instrument: tuple[Rod, ...]
    instrument_heading: float

    @staticmethod
    def drawn(seed: int, conditions: Conditions) -> "Look":
        """The look of a seed under given conditions."""
        rng = np.random.default_rng([seed, 0x4C4F4B])
        lens = _lens(rng)
        return Look(
            seed=seed,
            head=_head(rng, conditions),
            border=_border(rng),
            tissues=_tissues(rng, conditions),
            clutter=_clutter(rng, conditions),
            light=_light(rng, conditions),
            lens=lens,
            gap=float(rng.uniform(0.0022, 0.0065)),
            roll=float(rng.uniform(-1.1, 1.1)),
            # Far enough that the instrument of the true gap, which reaches 10 mm behind it, never meets it.
            wall_behind=float(rng.uniform(0.022, 0.040)),
            wall_aside=float(rng.uniform(0.0105, 0.0190)),
            condyle_aside=float(rng.normal(0.0, 0.0055)),
            rim_bend=float(rng.uniform(-40.0, 110.0)),
            instrument=_INSTRUMENTS[str(rng.choice(list(_INSTRUMENTS)))],
            instrument_heading=float(rng.uniform(-0.7, 0.9)),
        )

    def shaped(self, scene: KneeScene, travel: float) -> KneeScene:
        """The scene with this look's wall and opening; its gap stays as it is."""
        behind, before = self.wall_behind, 0.030
        aside = max(self.wall_aside, 0.5 * travel + 0.0045)
        x, y, z = scene.condyle_centre
        changed = replace(
            scene,
            condyle_centre=(x + self.condyle_aside, y, z),
            rim_bend_y=scene.rim_bend_y + self.rim_bend,
            capsule_centre=(0.0, 0.0, 0.5 * (behind - before)),
            capsule_radii=(aside, scene.capsule_radii[1], 0.5 * (behind + before)),
        )
        return changed.opened()

    def with_instrument(self, probe: Probe) -> Probe:
        """The probe's visits with this look's instrument."""
        return replace(probe, rods=self.instrument, heading=self.instrument_heading)


# Rods of instruments: along the shaft, along the hook, radius [m].
_INSTRUMENTS: dict[str, tuple[Rod, ...]] = {
    "probe": HOOK,
    "shaver": ((0.030, 0.0, 0.0024), (0.0012, 0.0, 0.0024), (0.0, 0.0, 0.0016)),
    "burr": ((0.030, 0.0, 0.0016), (0.0030, 0.0, 0.0016), (0.0018, 0.0, 0.0022), (0.0, 0.0, 0.0021)),
    "grasper": ((0.030, 0.0, 0.0014), (0.0045, 0.0, 0.0014), (0.0, 0.0004, 0.0006)),
    "wand": ((0.030, 0.0, 0.0017), (0.0022, 0.0, 0.0017), (0.0, 0.0008, 0.0012)),
    "needle": ((0.030, 0.0, 0.0005), (0.0, 0.0, 0.00035)),
}
# Black plastic, grey, steel, steel that mirrors warm tissue, white ceramic; and their gloss.
_METALS: tuple[tuple[Colour, float], ...] = (
    ((22, 22, 24), 2.5),
    ((92, 92, 92), 4.0),
    ((172, 175, 178), 8.0),
    ((178, 138, 112), 7.0),
    ((120, 92, 72), 6.0),
    ((225, 224, 220), 1.5),
)
_CARTILAGE: tuple[Colour, ...] = (
    (240, 238, 234),
    (232, 237, 243),
    (236, 240, 234),
    (242, 234, 222),
    (236, 232, 208),
    (244, 230, 224),
    (228, 222, 216),
)
_WALLS: tuple[tuple[Colour, Colour], ...] = (
    ((196, 96, 84), (150, 44, 40)),
    ((214, 140, 122), (188, 84, 74)),
    ((226, 186, 160), (214, 130, 110)),
    ((228, 186, 130), (216, 150, 112)),
    ((150, 124, 104), (110, 78, 62)),
    ((206, 188, 178), (196, 140, 128)),
    ((132, 54, 42), (84, 24, 20)),
)


def _picked(rng: np.random.Generator, colours: tuple[Colour, ...], jitter: float = 6.0) -> Colour:
    red, green, blue = np.clip(np.add(colours[rng.integers(len(colours))], rng.normal(0, jitter, 3)), 0, 250)
    return int(red), int(green), int(blue)


def _lens(rng: np.random.Generator) -> Lens:
    kind = rng.choice(["whole", "cut", "masked", "zoomed"], p=[0.42, 0.32, 0.12, 0.14])
    # A zoomed field fills the picture: small sizes keep the number of its pixels, and so its cost, as it is.
    sizes = (
        ((960, 540), (800, 600)) if kind == "zoomed" else ((1280, 720), (960, 720), (960, 540), (800, 600))
    )
    width, height = sizes[rng.integers(len(sizes))]
    shares = {"whole": (0.42, 0.495), "cut": (0.51, 0.60), "masked": (0.43, 0.50), "zoomed": (0.78, 0.98)}
    radius = height * float(rng.uniform(*shares[str(kind)]))
    if kind == "zoomed":
        radius = min(radius, 0.97 * 0.5 * float(np.hypot(width, height)))
    cut = (
        height * float(rng.uniform(0.02, 0.10)) + max(0.0, 0.5 * height - radius) if kind == "masked" else 0.0
    )
    field = np.radians(rng.uniform(76.0, 96.0))
    x, y = rng.normal(0.0, 0.012, 2) * height
    return Lens(
        width_px=width,
        height_px=height,
        focal_px=float(radius / (field / 2.0)),
        centre_x_px=float(0.5 * (width - 1) + x),
        centre_y_px=float(0.5 * (height - 1) + (0.3 * y if kind == "whole" else y)),
        field_of_view=float(field),
        cut_top_px=float(np.round(cut)),
        cut_bottom_px=float(np.round(cut)),
    )


def _colours(rng: np.random.Generator) -> Array:
    # White balance: mostly near neutral, blue between 0.85 and 1.3 of red; sometimes a strong cast.
    strong = rng.random() < 0.22
    blue = np.exp(rng.normal(0.0, 0.22 if strong else 0.09))
    green = np.exp(rng.normal(0.0, 0.06 if strong else 0.025))
    saturation = rng.uniform(0.55, 1.45)
    luma = np.array([0.11, 0.59, 0.30])
    mixed = saturation * np.eye(3) + (1.0 - saturation) * luma[None, :]
    return np.asarray(mixed * np.array([blue, green, 1.0])[:, None])


def _head(rng: np.random.Generator, conditions: Conditions) -> Head:
    fringe = rng.uniform(0.4, 2.6) if rng.random() < 0.5 else 0.0
    order = rng.permutation(3)
    shifts = fringe * np.array([0.0, -0.5, -1.0])[order]
    return Head(
        colours=_colours(rng),
        target=float(rng.uniform(0.44, 0.76)),
        shoulder=float(rng.choice([0.5, 0.65, 0.8, 0.95])),
        black=float(rng.choice([0.0, 0.0, 0.004, 0.012])),
        sharpening=float(rng.uniform(0.0, 1.1)),
        bloom=float(rng.uniform(0.0, 0.10)) + conditions.bloom,
        fringe_px=(float(shifts[0]), float(shifts[1]), float(shifts[2])),
        warmth=float(rng.normal(0.07, 0.07)),
        softness=float(rng.uniform(0.6, 1.8)),
    )


_LINES = ("01/03  11:42:07", "LEFT KNEE", "2024-05-17", "ID 00417", "0:07:53", "REC", "ARTHRO 30", "M 47Y")


def _border(rng: np.random.Generator) -> Border:
    kind = rng.choice(["none", "in", "out"], p=[0.3, 0.3, 0.4])
    height = {"none": 0.0, "in": rng.uniform(0.04, 0.09), "out": -rng.uniform(0.05, 0.125)}[str(kind)]
    surround: Colour = (0, 0, 0)
    if rng.random() < 0.3:
        level = rng.uniform(4.0, 44.0)
        red, green, blue = level * np.exp(rng.normal(0.0, 0.15, 3))
        surround = int(red), int(green), int(blue)
    lines = rng.choice(_LINES, size=rng.integers(1, 4), replace=False) if rng.random() < 0.35 else ()
    return Border(
        notch_angle=float(rng.uniform(-np.pi, np.pi)),
        notch_height=float(height),
        notch_half_width=float(np.radians(rng.uniform(1.6, 4.5))),
        notch_light=float(rng.uniform(0.25, 1.0)),
        surround=surround,
        grain=float(rng.uniform(0.0, 2.0)),
        margin=bool(rng.random() < 0.08),
        lines=tuple(str(line) for line in lines),
        labels=int(rng.integers(1, 4)) if rng.random() < 0.06 else 0,
    )


def _tissues(rng: np.random.Generator, conditions: Conditions) -> Tissues:
    cartilage = _picked(rng, _CARTILAGE)
    wall, blush = _WALLS[rng.integers(len(_WALLS))]
    metal, gloss = _METALS[rng.integers(len(_METALS))]
    detail = conditions.contrast * float(np.exp(rng.uniform(np.log(0.3), np.log(1.3))))
    tint: Colour = (230, 218, 204)
    return Tissues(
        condyle=cartilage,
        plateau=_picked(rng, (cartilage,), 5.0),
        meniscus=_picked(rng, (cartilage, tint, (234, 214, 196), (238, 232, 228)), 5.0),
        wall=_picked(rng, (wall,), 8.0),
        wall_blush=_picked(rng, (blush,), 8.0),
        instrument=_picked(rng, (metal,), 4.0),
        blush=float(rng.uniform(0.0, 0.35)),
        mottle=0.05 * detail,
        grain=0.03 * detail,
        fibres=0.05 * detail * float(rng.uniform(0.6, 3.0)),
        relief=float(rng.uniform(0.012, 0.045)),
        wall_mottle=float(rng.uniform(0.08, 0.24)),
        wall_relief=float(rng.uniform(0.06, 0.20)),
        wall_vessels=int(rng.integers(0, 12)),
        meniscus_vessels=int(rng.integers(0, 4)) if rng.random() < 0.5 else 0,
        instrument_gloss=gloss,
        bleeding=float(rng.uniform(0.1, 0.8)) if rng.random() < 0.25 else 0.0,
    )


def _clutter(rng: np.random.Generator, conditions: Conditions) -> Clutter:
    # As much as the level's debris, 0, 6, 18 or 40, and something at the easiest level too.
    amount = 0.45 + 0.04 * conditions.debris

    def some(share: float, most: float) -> int:
        drawn = rng.uniform(0.15, 1.0) * most
        return round(drawn * amount) if rng.random() < share else 0

    return Clutter(
        villi=some(0.5, 70.0),
        frays=some(0.6, 90.0),
        strands=some(0.3, 5.0),
        sutures=some(0.2, 3.0),
        bubbles=some(0.2, 9.0),
        fibres=some(0.4, 30.0),
        near=float(rng.uniform(0.15, 0.55)) * min(1.0, amount) if rng.random() < 0.15 else 0.0,
    )


def _light(rng: np.random.Generator, conditions: Conditions) -> Light:
    return Light(
        position=(float(rng.normal(0.0, 0.0008)), float(rng.normal(-0.0008, 0.0008)), -0.0002),
        spread=conditions.beam * float(rng.uniform(0.6, 2.4)),
        absorption=conditions.absorption * float(rng.uniform(0.5, 1.2)),
        glare=conditions.glare * float(rng.uniform(0.3, 1.3)),
        shininess=float(rng.uniform(40.0, 160.0)),
        # Light that the white joint scatters into its own depth.
        ambient=float(np.exp(rng.uniform(np.log(0.004), np.log(0.10)))),
        glint=float(rng.uniform(1.5, 4.0)),
        sheen=float(rng.uniform(0.02, 0.08)),
        facing_exponent=float(rng.uniform(0.30, 0.70)),
    )


def shared_rng(seed: int, purpose: int) -> np.random.Generator:
    """A generator for one purpose of a look."""
    return np.random.default_rng([seed, 0x4C4F4B, purpose])
