"""Openings, shades and instruments that are drawn into examples, so that few pictures show many of them.

An opening is drawn as it comes about: one picture lies behind the other, past a curved edge. Its wall is
dark or lit, evenly or by depth. A shade darkens the same tissue, without an edge: it is no opening.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Image, Mask
from knee_gap_core.values.pixel_classes import PixelClass
from knee_gap_perception.training.examples import STORED_SIDE, Example

Plane = npt.NDArray[np.float32]

_HALF = STORED_SIDE / 2.0
_ROWS, _COLUMNS = np.mgrid[0:STORED_SIDE, 0:STORED_SIDE].astype(np.float32)
LIT_WALLS = 0.4  # share of openings with a wall that is lit
FRAYED = 0.35  # share of openings with a frayed edge
INK = ((200, 90, 30), (40, 40, 40), (235, 235, 235), (60, 150, 60), (150, 60, 120), (180, 160, 40))
STEEL = ((18, 18, 20), (45, 45, 45), (95, 95, 95), (150, 150, 150), (200, 200, 195), (120, 130, 165))


def with_opening(rng: np.random.Generator, example: Example, behind: Example) -> Example:
    """An example with one more opening, through which the tissue of another one is seen."""
    depth = _band(rng)
    soft = float(rng.uniform(0.8, 3.0))
    front = np.isin(example.labels, (PixelClass.INSTRUMENT,))
    alpha = np.clip(0.5 + depth / soft, 0.0, 1.0) * ~front
    image = example.image.astype(np.float32)
    wall = _wall(rng, example, behind, depth)
    # Beside the edge the tissue turns away from the lamp, or catches it.
    turned = 1.0 + rng.uniform(-0.45, 0.3) * np.exp(np.minimum(depth, 0.0) / rng.uniform(2.0, 14.0))
    if rng.random() < 0.5:
        side = (_along(rng)[1] > 0.0).astype(np.float32)
        turned = 1.0 + (turned - 1.0) * side
    mixed = image * turned[..., None] * (1.0 - alpha[..., None]) + wall * alpha[..., None]
    opened = (alpha > 0.5) & np.isin(example.labels, (PixelClass.TISSUE, PixelClass.GLARE))
    labels = np.where(opened, np.uint8(PixelClass.GAP), example.labels)
    return Example(example.name, example.source, _bytes(mixed), labels, example.sha256)


def with_lit_gap(rng: np.random.Generator, example: Example) -> Example:
    """An example whose gap is lit, from some to nearly all of the tissue's brightness."""
    gap = example.labels == PixelClass.GAP
    level = float(np.median(example.image.max(axis=2)[gap])) if gap.any() else 0.0
    factor = rng.uniform(0.2, 0.85) * _level(example) / max(level, 4.0)
    if not gap.any() or factor <= 1.0:
        return example
    soft = cv2.GaussianBlur(gap.astype(np.float32), (0, 0), 1.0)
    image = example.image * (1.0 + (factor - 1.0) * soft)[..., None]
    return Example(example.name, example.source, _bytes(image), example.labels, example.sha256)


def with_shade(rng: np.random.Generator, example: Example) -> Example:
    """An example with a dark place that is no opening: a crease or a shaded flank."""
    depth = _band(rng)
    if rng.random() < 0.5:
        soft = float(rng.uniform(6.0, 26.0))
        shade = 1.0 / (1.0 + np.exp(-np.clip(depth / soft * 4.0, -20.0, 20.0)))
    else:  # a thin crease, dark at its bottom
        along, across = _along(rng)
        shade = np.exp(-np.abs(across - _bow(rng, along)) / rng.uniform(1.5, 7.0))
    strength = rng.uniform(0.3, 0.95)
    dark = example.labels != PixelClass.INSTRUMENT
    image = example.image * (1.0 - strength * shade * dark)[..., None]
    return Example(example.name, example.source, _bytes(image), example.labels, example.sha256)


def with_instrument(rng: np.random.Generator, example: Example, others: Sequence[Example]) -> Example:
    """An example with an instrument: drawn, or cut out of one of the others."""
    if others and rng.random() < 0.4:
        return _pasted(rng, example, others[rng.integers(len(others))])
    cover, colour = _thread(rng) if rng.random() < 0.25 else _shaft(rng, example)
    cover = cover * (example.labels != PixelClass.OUTSIDE)
    image = example.image * (1.0 - cover[..., None]) + colour * cover[..., None]
    return _covered(example, image, cover > 0.5)


def _covered(example: Example, image: Plane, cover: Mask) -> Example:
    labels = np.where(cover, np.uint8(PixelClass.INSTRUMENT), example.labels)
    return Example(example.name, example.source, _bytes(image), labels, example.sha256)


def _pasted(rng: np.random.Generator, example: Example, other: Example) -> Example:
    turned = cv2.getRotationMatrix2D((_HALF, _HALF), rng.uniform(0, 360), rng.uniform(0.7, 1.4))
    matrix = np.asarray(turned, np.float64)
    matrix[:, 2] += rng.uniform(-0.2, 0.2, 2) * STORED_SIDE
    side = (STORED_SIDE, STORED_SIDE)
    made = (other.labels == PixelClass.INSTRUMENT).astype(np.float32)
    cover = cv2.GaussianBlur(cv2.warpAffine(made, matrix, side, flags=cv2.INTER_LINEAR), (0, 0), 0.8)
    cover = cover * (example.labels != PixelClass.OUTSIDE)
    image = cv2.warpAffine(other.image, matrix, side, flags=cv2.INTER_LINEAR)
    light = _level(example) / max(_level(other), 1.0)
    mixed = example.image * (1.0 - cover[..., None]) + image * (light * cover[..., None])
    return _covered(example, np.asarray(mixed, np.float32), np.asarray(cover > 0.5))


def _shaft(rng: np.random.Generator, example: Example) -> tuple[Plane, Plane]:
    """Cover (side, side) and colour (side, side, 3) of a shaft that enters from the rim."""
    along, across = _along(rng)
    width = float(np.exp(rng.uniform(np.log(0.025), np.log(0.2)))) * _HALF
    tip = rng.uniform(-0.8, 0.5) * _HALF
    taper = 1.0 + rng.uniform(-0.3, 0.1) * along / _HALF
    across = across - rng.uniform(-0.5, 0.5) * _HALF
    body = width * taper - np.abs(across)
    end = along - tip
    inside = np.minimum(body, end + np.sqrt(np.maximum(width**2 - across**2, 0.0)) * rng.uniform(0.0, 1.0))
    if rng.random() < 0.35:  # jaws or a hook
        lean = rng.uniform(0.2, 1.0) * rng.choice([-1.0, 1.0])
        jaw = 0.45 * width - np.abs(across + lean * (end + 0.2 * width))
        inside = np.maximum(inside, np.minimum(np.minimum(jaw, -end), end + rng.uniform(1.0, 3.5) * width))
    place = np.clip(across / (width * taper), -1.0, 1.0)
    steel = np.array(STEEL[rng.integers(len(STEEL))], np.float32) + rng.normal(0.0, 6.0, 3)
    lit = 0.55 + 0.45 * np.cos((place - rng.uniform(-0.6, 0.6)) * rng.uniform(0.8, 1.6))
    gloss = rng.uniform(0.0, 200.0) * np.exp(-(((place - rng.uniform(-0.7, 0.7)) / 0.12) ** 2))
    reach = 1.0 - rng.uniform(0.0, 0.6) * np.clip(end / STORED_SIDE, 0.0, 1.0)
    colour = steel * lit[..., None] * reach[..., None] + gloss[..., None]
    if rng.random() < 0.3:  # steel mirrors the tissue
        colour = 0.6 * colour + 0.4 * cv2.GaussianBlur(example.image, (0, 0), 9.0)
    if rng.random() < 0.3:  # rings and marks along the shaft
        rings = np.sin(along * rng.uniform(0.2, 0.9)) > rng.uniform(0.3, 0.9)
        colour = colour * (1.0 - 0.6 * rings[..., None])
    soft = rng.uniform(0.8, 3.0)
    return np.clip(0.5 + inside / soft, 0.0, 1.0), np.clip(colour, 0.0, 255.0)


def _thread(rng: np.random.Generator) -> tuple[Plane, Plane]:
    """Cover and colour of a suture."""
    cover = np.zeros((STORED_SIDE, STORED_SIDE), np.uint8)
    points = rng.uniform(0.1, 0.9, (4, 2)) * STORED_SIDE
    share = np.linspace(0.0, 1.0, 24)[:, None]
    curve = (1 - share) ** 3 * points[0] + 3 * share * (1 - share) ** 2 * points[1]
    curve = curve + 3 * share**2 * (1 - share) * points[2] + share**3 * points[3]
    cv2.polylines(
        cover, [np.rint(curve).astype(np.int32)], False, (255,), int(rng.integers(2, 7)), cv2.LINE_AA
    )
    ink = np.array(INK[rng.integers(len(INK))], np.float32) + rng.normal(0.0, 12.0, 3)
    braid = 1.0 + 0.25 * np.sin((_ROWS + _COLUMNS) * rng.uniform(0.5, 1.5))
    return (cover / 255.0).astype(np.float32), np.clip(ink * braid[..., None], 0.0, 255.0)


def _wall(rng: np.random.Generator, example: Example, behind: Example, depth: Plane) -> Plane:
    """What is seen through an opening of a depth inside its edges (side, side) [px]: (side, side, 3)."""
    matrix = cv2.getRotationMatrix2D((_HALF, _HALF), rng.uniform(0, 360), rng.uniform(0.8, 1.6))
    side = (STORED_SIDE, STORED_SIDE)
    turned = cv2.warpAffine(behind.image, matrix, side, borderMode=cv2.BORDER_REFLECT).astype(np.float32)
    wall = np.asarray(cv2.GaussianBlur(turned, (0, 0), float(rng.uniform(0.3, 3.0))), np.float32)
    lit = rng.random() < LIT_WALLS
    share = rng.uniform(0.3, 0.95) if lit else np.exp(rng.uniform(np.log(0.02), np.log(0.35)))
    tint = np.array([rng.uniform(0.5, 1.05), rng.uniform(0.6, 1.05), 1.0])
    level = share * _level(example) / max(_level(behind), 1.0)
    # Light does not reach behind the nearer edge, and falls off with depth.
    shadow = 1.0 - rng.uniform(0.0, 0.9) * np.exp(-np.maximum(depth, 0.0) / rng.uniform(2.0, 20.0))
    slope = 1.0 + rng.uniform(-0.5, 0.5) * _along(rng)[0] / _HALF
    return np.asarray(wall * tint * level * (shadow * slope)[..., None] + rng.uniform(0.0, 8.0), np.float32)


def _band(rng: np.random.Generator) -> Plane:
    """Depth (side, side) [px] inside a random slit, crescent, wedge or triangle; below 0 outside."""
    along, across = _along(rng)
    across = across - rng.uniform(-0.75, 0.75) * _HALF - _bow(rng, along)
    length = rng.uniform(0.2, 1.5) * _HALF
    width = float(np.exp(rng.uniform(np.log(0.04), np.log(0.35)))) * _HALF
    along = along - rng.uniform(-0.5, 0.5) * _HALF
    place = np.clip(along / length, -1.0, 1.0)
    kind = rng.integers(3)
    if kind == 0:
        profile = np.maximum(1.0 - np.abs(place) ** rng.uniform(1.0, 4.0), 0.0)
    elif kind == 1:
        profile = 0.5 * (place + 1.0)
    else:
        profile = np.maximum(1.0 - np.abs(place), 0.0)
    edge = rng.uniform(0.0, 0.25) * width * np.sin(along / rng.uniform(4.0, 25.0) + rng.uniform(0, 6.3))
    if rng.random() < FRAYED:
        noise = rng.normal(0.0, 1.0, (STORED_SIDE // 4, STORED_SIDE // 4)).astype(np.float32)
        frays = cv2.resize(noise, (STORED_SIDE, STORED_SIDE), interpolation=cv2.INTER_CUBIC)
        edge = edge + rng.uniform(1.0, 5.0) * frays * (across > 0.0)
    ends = np.where(np.abs(along) > length, np.abs(along) - length, 0.0)
    # A one-sided profile makes a crescent: one edge straight, the other bowed.
    if rng.random() < 0.4:
        across = across - 0.5 * width * profile
    return np.asarray(width * profile - np.abs(across) + edge - ends, np.float32)


def _along(rng: np.random.Generator) -> tuple[Plane, Plane]:
    """Coordinates along and across a random direction through the middle [px]."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    x, y = _COLUMNS - np.float32(_HALF), _ROWS - np.float32(_HALF)
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return x * cosine + y * sine, y * cosine - x * sine


def _bow(rng: np.random.Generator, along: Plane) -> Plane:
    return np.asarray(rng.uniform(-0.5, 0.5) * along**2 / _HALF, np.float32)


def _level(example: Example) -> float:
    """Brightness of an example's tissue."""
    tissue = example.image.max(axis=2)[example.labels == PixelClass.TISSUE]
    return float(np.median(tissue)) if tissue.size else 128.0


def _bytes(image: npt.NDArray[Any]) -> Image:
    return np.asarray(np.clip(image, 0.0, 255.0), np.uint8)
