"""The border of the field of view, direction by direction: where from outside in the picture begins."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.image.field_of_view import FieldOfView, brightness

STEPS = 480  # around the border: three quarters of a degree, six pixels of a field of 450 px
STEP = 2.0 * np.pi / STEPS
INNER, OUTER = 0.80, 1.18  # band that is looked at, in radii of the field
SURROUND = 1.04  # from here on outwards a direction shows what lies outside the field
TISSUE = 0.88  # up to here from inside a direction shows what lies in the picture, never the notch
ACROSS = 0.005  # between two samples where the border may be; twice that beyond, where nothing is measured
LEVEL = (
    0.18  # of the way from black to the brightness inside, at which the picture begins: the stop is black,
)
LEAST_LEVEL = 10.0  # [grey levels] and what is dark in the picture is not
SMOOTH = 27  # directions (20 degrees) over which the brightness inside is levelled
DARK = 22.0  # [grey levels] above black, below which a direction shows no tissue: the gap, or nothing
DARK_SAMPLES = 1  # of a direction that is lit all the way
CIRCLE_PASSES = 3
OFF_CIRCLE = 0.012  # of the radius, beyond which a direction is not a part of the circle
FEWEST_ON_CIRCLE = 0.35  # of all directions

_ANGLES = np.arange(STEPS) * STEP
_RADII = np.concatenate(
    [
        np.arange(OUTER, SURROUND + ACROSS, -2 * ACROSS),
        np.arange(SURROUND, TISSUE, -ACROSS),
        np.arange(TISSUE, INNER - ACROSS, -2 * ACROSS),
    ]
)
SAMPLES = len(_RADII)
BEYOND, WITHIN = int((_RADII > SURROUND + ACROSS / 2).sum()), int((_RADII > TISSUE + ACROSS / 2).sum())
_DESIGN = np.stack([np.ones(STEPS), np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


class Band(NamedTuple):
    """Where the band's samples lie in the image, and which of them do (STEPS, SAMPLES)."""

    maps: tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]
    inside: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Border:
    """How far the border reaches into the field (STEPS,), in its radii; NaN where it does not show.

    Direction i is the angle i * STEP about `centre` (2,) [px], from the image's x to its y. 0 is the circle
    through the border itself, of `radius` [px]. `solid` (STEPS,) is whether all is lit inside it, as far as
    the band goes.
    """

    depth: Array
    solid: npt.NDArray[np.bool_]
    centre: tuple[float, float]
    radius: float


def find_border(image: npt.NDArray[np.uint8], field: FieldOfView) -> Border | None:
    """The border in an image (h, w, 3); None if too little of it shows to find its circle.

    A direction that shows no tissue just inside, as where the gap runs to the border, has no border.
    """
    if not np.isfinite(field.radius) or not field.radius > 40.0:
        return None
    centre = (round(field.centre[0], 1), round(field.centre[1], 1))
    band = _band(centre, round(field.radius, 1), field.box)
    samples = cv2.remap(image, band.maps[0], band.maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light = brightness(np.asarray(samples, np.uint8))
    surround = light[::8, :BEYOND][band.inside[::8, :BEYOND]]
    # Where the disc touches the frame there is no surround to look at; black is then 0.
    black = float(np.median(surround)) if surround.size > STEPS // 8 else 0.0
    tissue = np.asarray(
        cv2.reduce(light[:, WITHIN:], 1, cv2.REDUCE_AVG, dtype=cv2.CV_64F)[:, 0], dtype=np.float64
    )
    reach, solid = _reach(light, band.inside, black, tissue)
    reach[tissue < black + DARK] = np.nan
    return _about_its_circle(reach, solid, centre, round(field.radius, 1))


@lru_cache(maxsize=4)
def _band(centre: tuple[float, float], radius: float, box: tuple[float, float, float, float]) -> Band:
    x = centre[0] + radius * np.outer(np.cos(_ANGLES), _RADII)
    y = centre[1] + radius * np.outer(np.sin(_ANGLES), _RADII)
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    maps = cv2.convertMaps(x.astype(np.float32), y.astype(np.float32), cv2.CV_16SC2)
    return Band((np.asarray(maps[0], np.int16), np.asarray(maps[1], np.uint16)), inside)


def _reach(
    light: npt.NDArray[np.uint8], inside: npt.NDArray[np.bool_], black: float, tissue: Array
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Radius (STEPS,) at which each direction first is lit, between two samples; NaN where it never is.

    And whether it is lit all the way from there.
    """
    half = SMOOTH // 2
    wrapped = np.concatenate([tissue[-half:], tissue, tissue[:half]])
    inner = np.convolve(wrapped, np.full(SMOOTH, 1.0 / SMOOTH), mode="valid")
    level = black + np.maximum(LEVEL * (inner - black), LEAST_LEVEL)
    lit = light > np.clip(level, 0, 255).astype(np.uint8)[:, None]
    lit &= inside
    first = lit.argmax(axis=1)
    every = np.arange(STEPS)
    before = np.maximum(first - 1, 0)
    dark, bright = light[every, before].astype(np.float64), light[every, first].astype(np.float64)
    share = np.clip((level - dark) / np.maximum(bright - dark, 1.0), 0.0, 1.0)
    reach = _RADII[before] + share * (_RADII[first] - _RADII[before])
    # Light that is cut by the frame's side, rather than by the field stop, does not show the border.
    reach[~inside[every, before] | (first == 0)] = np.nan
    return np.asarray(reach), lit.sum(axis=1) >= SAMPLES - first - DARK_SAMPLES


def _about_its_circle(
    reach: Array, solid: npt.NDArray[np.bool_], centre: tuple[float, float], radius: float
) -> Border | None:
    """The border found from the circle on which most of it lies."""
    known = np.flatnonzero(np.isfinite(reach))
    if len(known) < FEWEST_ON_CIRCLE * STEPS:
        return None
    design, seen = _DESIGN[known], reach[known]
    off, limit = seen - np.median(seen), 4.0 * OFF_CIRCLE
    for _ in range(CIRCLE_PASSES):
        weight = (np.abs(off) < limit).astype(np.float64)
        if weight.sum() < FEWEST_ON_CIRCLE * STEPS:
            return None
        weighted = design * weight[:, None]
        circle = np.linalg.solve(weighted.T @ design + 1e-9 * np.eye(3), weighted.T @ seen)
        off, limit = seen - design @ circle, OFF_CIRCLE
    # Seen from the circle's own centre the directions turn a little.
    x, y = circle[1] / circle[0], circle[2] / circle[0]
    depth = (_DESIGN @ circle - reach) / circle[0]
    back = y * _DESIGN[:, 1] - x * _DESIGN[:, 2]
    depth = _moved(depth, back / STEP)
    moved = (centre[0] + radius * float(circle[1]), centre[1] + radius * float(circle[2]))
    return Border(np.asarray(depth), solid, moved, radius * float(circle[0]))


def _moved(depth: Array, steps: Array) -> Array:
    """Values (STEPS,) about another centre, whose directions see what is `steps` further on from here."""
    place = np.arange(STEPS) + steps
    whole = np.floor(place)
    share, index = place - whole, whole.astype(np.intp) % STEPS
    return np.asarray((1.0 - share) * depth[index] + share * depth[(index + 1) % STEPS])
