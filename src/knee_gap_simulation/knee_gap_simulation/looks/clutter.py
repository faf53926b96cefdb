"""Small things before the tissue in a look: villi, frayed edges, strands, sutures, bubbles.

They are fixed in the scene and drawn over the picture, each behind whatever tissue is nearer. What they cover
is reported with the debris. They are thin, so that they do not belong to the truth of the gap.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.looks.look import Colour, Look, shared_rng
from knee_gap_simulation.scope.imaging import FloatImage
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.distance_field import CAPSULE, MENISCUS
from knee_gap_simulation.surfaces.textures import linear_from_srgb

# Points, normals, surfaces, lengths of rays from an origin (3,) in directions (n, 3).
Cast = Callable[[Array, Array], tuple[Array, Array, npt.NDArray[np.uint8], Array]]

_GRID = 48
_JUMP = 1.12  # ratio of the lengths of neighbouring rays at an edge
_NEAREST = 1.5e-3  # [m]: what is closer to the lens is not drawn
_FOCUS = 0.010

_WHITES = ((238, 234, 228), (226, 222, 214), (240, 228, 220))
_REDS = ((222, 120, 106), (206, 88, 80), (232, 168, 148), (190, 60, 58))
_THREADS = ((30, 140, 160), (28, 60, 150), (24, 24, 30), (236, 236, 240), (90, 60, 140), (40, 120, 70))


@dataclass(frozen=True)
class _Thread:
    """A curved thread: points (n, 3) [m], width at either end [m], linear colour, opacity."""

    points: Array
    width: float
    tip_width: float
    colour: Array
    opacity: float
    braid: float = 0.0


@dataclass(frozen=True)
class _Bubble:
    centre: Array
    radius: float


class _Sights(NamedTuple):
    """Points (n, 3) of tissue in view, normals (n, 3), surfaces (n,), and whether each is an edge (n,)."""

    points: Array
    normals: Array
    surfaces: npt.NDArray[np.uint8]
    edges: npt.NDArray[np.bool_]


class Clutter:
    """The small things of one look in one scene, as they lie along the travel of the lens."""

    def __init__(self, look: Look, cast: Cast, lens: Lens, poses: Array) -> None:
        """``poses`` (n, 4, 4) are lens poses in the scene from which the tissue is sought."""
        rng, wanted = shared_rng(look.seed, 3), look.clutter
        self._threads: list[_Thread] = []
        self._bubbles: list[_Bubble] = []
        self._lens = lens
        if wanted == type(wanted)(0, 0, 0, 0, 0, wanted.fibres, wanted.near):
            return
        seen = _sights(cast, lens, poses)
        if len(seen.points) == 0:
            return
        edges = np.flatnonzero(seen.edges & (seen.surfaces != CAPSULE))
        for index in _chosen(rng, edges, wanted.frays):
            self._threads.append(_fray(rng, seen, index))
        walls = np.flatnonzero(seen.surfaces == CAPSULE)
        for index in _chosen(rng, walls if len(walls) > 20 else np.arange(len(seen.points)), wanted.villi):
            self._threads.append(_villus(rng, seen, index, look.tissues.wall))
        menisci = np.flatnonzero(seen.surfaces == MENISCUS)
        places = menisci if len(menisci) > 20 else np.arange(len(seen.points))
        for count, make in ((wanted.strands, _strand), (wanted.sutures, _suture)):
            for index in _chosen(rng, places, count):
                self._threads.append(make(rng, seen, index))
        middle = poses[len(poses) // 2]
        for _ in range(wanted.bubbles):
            place = middle[:3, 3] + middle[:3, :3] @ (
                np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.6, 0.3), 1.0]) * rng.uniform(0.004, 0.011)
            )
            self._bubbles.append(_Bubble(place, float(rng.lognormal(np.log(0.45e-3), 0.5))))

    def over(
        self,
        image: FloatImage,
        cover: FloatImage,
        T_scene_lens: Array,
        lengths: Array,
        time: float,
        corner_px: tuple[int, int],
        softness_px: float,
    ) -> None:
        """Draw over the image (h, w, 3), and add to its cover (h, w); as `Debris.over`, but in place."""
        scratch = np.zeros(cover.shape, np.float32)
        corner = np.array([corner_px[1], corner_px[0]], dtype=np.float64)
        for index, thread in enumerate(self._threads):
            points = thread.points.copy()
            # Free ends sway in the flow.
            bend = np.linspace(0.0, 1.0, len(points))[:, None] ** 2
            sway = 0.06 * np.linalg.norm(points[-1] - points[0])
            points += bend * sway * np.sin(2.5 * time + index + np.array([0.0, 1.0, 2.0]))
            in_lens = (points - T_scene_lens[:3, 3]) @ T_scene_lens[:3, :3]
            far = np.linalg.norm(in_lens, axis=1)
            pixels = self._lens.pixels(in_lens) - corner
            if not np.isfinite(pixels).all() or far.min() < _NEAREST:
                continue
            scale = self._lens.focal_px / far
            widths = np.linspace(thread.width, thread.tip_width, len(points)) * scale
            middle = len(points) // 2
            distance = float(far[middle])
            light = min(3.0, (_FOCUS / distance) ** 2) * float(in_lens[middle, 2] / distance) ** 2
            soft = softness_px * (1.0 + 2.0 * abs(_FOCUS / distance - 1.0))
            _paint_thread(
                image,
                cover,
                scratch,
                lengths,
                pixels,
                far,
                widths,
                soft,
                thread.opacity,
                thread.braid,
                0.85 * light * thread.colour,
            )
        for bubble in self._bubbles:
            in_lens = T_scene_lens[:3, :3].T @ (bubble.centre - T_scene_lens[:3, 3])
            distance = float(np.linalg.norm(in_lens))
            pixel = self._lens.pixels(in_lens) - corner
            if not np.isfinite(pixel).all() or distance < 2.0 * bubble.radius + _NEAREST:
                continue
            _paint_bubble(
                image,
                cover,
                lengths,
                float(pixel[0]),
                float(pixel[1]),
                bubble.radius * self._lens.focal_px / distance,
                distance,
                min(2.5, (_FOCUS / distance) ** 2),
            )


def _sights(cast: Cast, lens: Lens, poses: Array) -> _Sights:
    """Tissue seen on a grid of rays from each pose."""
    shares = np.linspace(-0.97, 0.97, _GRID) * 0.5 * lens.field_of_view
    x, y = np.meshgrid(shares, shares)
    angle = np.hypot(x, y)
    scale = np.sinc(angle / np.pi)
    bearings = np.stack([x * scale, y * scale, np.cos(angle)], axis=-1)
    parts = []
    for pose in poses:
        found = cast(pose[:3, 3], bearings.reshape(-1, 3) @ pose[:3, :3].T)
        points, normals, surfaces, lengths = found
        reach = lengths.reshape(_GRID, _GRID)
        jump = np.zeros((_GRID, _GRID), bool)
        with np.errstate(invalid="ignore"):
            for axis in (0, 1):
                for way in (1, -1):
                    jump |= np.roll(reach, way, axis=axis) > _JUMP * reach
        jump[[0, -1]] = jump[:, [0, -1]] = False
        known = np.isfinite(lengths)
        parts.append((points[known], normals[known], surfaces[known], jump.ravel()[known]))
    joined = [np.concatenate([part[k] for part in parts]) for k in range(4)]
    return _Sights(joined[0], joined[1], joined[2].astype(np.uint8), joined[3].astype(bool))


def _chosen(rng: np.random.Generator, places: npt.NDArray[np.int64], count: int) -> list[int]:
    """Places of which neighbours are likely: tufts."""
    if count == 0 or len(places) == 0:
        return []
    centres = rng.integers(len(places), size=max(1, count // 12))
    offsets = rng.normal(0.0, 0.04 * len(places), count)
    picked = (centres[rng.integers(len(centres), size=count)] + offsets).astype(int) % len(places)
    return [int(places[index]) for index in picked]


def _tint(rng: np.random.Generator, colours: tuple[tuple[int, int, int], ...]) -> Array:
    colour = linear_from_srgb(np.array(colours[rng.integers(len(colours))]))[::-1]
    return np.asarray(colour * rng.uniform(0.7, 1.1))


def _curve(start: Array, heading: Array, length: float, bend: Array, count: int = 7) -> Array:
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.asarray(start + share * length * heading + share**2 * length * bend)


def _fray(rng: np.random.Generator, seen: _Sights, index: int) -> _Thread:
    """A fibre of a frayed edge."""
    heading = 0.6 * seen.normals[index] + rng.normal(0.0, 0.6, 3)
    heading /= np.linalg.norm(heading)
    length, width = rng.lognormal(np.log(0.7e-3), 0.5), rng.lognormal(np.log(0.07e-3), 0.4)
    points = _curve(seen.points[index], heading, length, rng.normal(0.0, 0.4, 3))
    return _Thread(points, width, 0.4 * width, _tint(rng, _WHITES), float(rng.uniform(0.35, 0.9)))


def _villus(rng: np.random.Generator, seen: _Sights, index: int, wall: Colour) -> _Thread:
    """A villus: a soft finger of synovium, in the colour of the wall or redder."""
    heading = seen.normals[index] + rng.normal(0.0, 0.4, 3)
    heading /= np.linalg.norm(heading)
    length, width = rng.lognormal(np.log(1.6e-3), 0.4), rng.lognormal(np.log(0.40e-3), 0.4)
    points = _curve(seen.points[index], heading, length, rng.normal(0.0, 0.7, 3))
    colour = _tint(rng, _REDS) if rng.random() < 0.4 else 1.3 * _tint(rng, (wall,))
    return _Thread(points, width, 0.55 * width, colour, float(rng.uniform(0.4, 0.85)))


def _strand(rng: np.random.Generator, seen: _Sights, index: int) -> _Thread:
    """A strand from one place of the tissue to another."""
    start = seen.points[index]
    away = np.linalg.norm(seen.points - start, axis=1)
    others = np.flatnonzero((away > 2e-3) & (away < 9e-3))
    end = seen.points[int(rng.choice(others))] if len(others) else start + 4e-3 * seen.normals[index]
    share = np.linspace(0.0, 1.0, 11)[:, None]
    lift = seen.normals[index] * rng.uniform(0.3e-3, 1.5e-3)
    points = start + share * (end - start) + 4.0 * share * (1.0 - share) * lift
    width = rng.lognormal(np.log(0.16e-3), 0.6)
    return _Thread(points, width, width, _tint(rng, _WHITES), float(rng.uniform(0.5, 0.95)))


def _suture(rng: np.random.Generator, seen: _Sights, index: int) -> _Thread:
    thread = _strand(rng, seen, index)
    width = float(rng.uniform(0.25e-3, 0.5e-3))
    return _Thread(thread.points, width, width, _tint(rng, _THREADS), 1.0, braid=0.35)


@compiled(nogil=True)
def _paint_thread(
    image: FloatImage,
    cover: FloatImage,
    scratch: FloatImage,
    lengths: Array,
    pixels: Array,
    far: Array,
    widths: Array,
    soft_px: float,
    opacity: float,
    braid: float,
    colour: Array,
) -> None:
    """Paint a polyline with soft borders; ``scratch`` (h, w) is zero before and after."""
    margin = int(0.5 * widths.max() + soft_px) + 2
    top = max(0, int(pixels[:, 1].min()) - margin)
    bottom = min(image.shape[0], int(pixels[:, 1].max()) + margin + 1)
    left = max(0, int(pixels[:, 0].min()) - margin)
    right = min(image.shape[1], int(pixels[:, 0].max()) + margin + 1)
    for k in range(pixels.shape[0] - 1):
        ax, ay = pixels[k, 0], pixels[k, 1]
        ux, uy = pixels[k + 1, 0] - ax, pixels[k + 1, 1] - ay
        squared = ux * ux + uy * uy + 1e-9
        for row in range(
            max(top, int(min(ay, ay + uy)) - margin), min(bottom, int(max(ay, ay + uy)) + margin + 1)
        ):
            for column in range(
                max(left, int(min(ax, ax + ux)) - margin), min(right, int(max(ax, ax + ux)) + margin + 1)
            ):
                dx, dy = column - ax, row - ay
                share = min(1.0, max(0.0, (dx * ux + dy * uy) / squared))
                if lengths[row, column] < far[k] + share * (far[k + 1] - far[k]) - 0.05e-3:
                    continue
                dx, dy = dx - share * ux, dy - share * uy
                width = widths[k] + share * (widths[k + 1] - widths[k])
                # A thread thinner than its blur covers only a part.
                part = min(1.0, width / (0.5 * width + 0.5 * soft_px))
                edge = min(1.0, max(0.0, 0.5 - 0.5 * (np.sqrt(dx * dx + dy * dy) - 0.5 * width) / soft_px))
                alpha = opacity * part * edge * edge * (3.0 - 2.0 * edge)
                scratch[row, column] = max(scratch[row, column], np.float32(alpha))
    for row in range(top, bottom):
        for column in range(left, right):
            alpha = scratch[row, column]
            if alpha <= 0.0:
                continue
            scratch[row, column] = 0.0
            shade = 1.0
            if braid > 0.0:
                shade += braid * np.sin(0.9 * row + 0.7 * column)
            for channel in range(3):
                image[row, column, channel] += alpha * (shade * colour[channel] - image[row, column, channel])
            cover[row, column] += alpha * (1.0 - cover[row, column])


@compiled(nogil=True)
def _paint_bubble(
    image: FloatImage,
    cover: FloatImage,
    lengths: Array,
    x_px: float,
    y_px: float,
    radius_px: float,
    far: float,
    light: float,
) -> None:
    """Paint a bubble: dark towards its rim, a bright ring, and the mirrored lamp."""
    reach = int(radius_px) + 3
    for row in range(max(0, int(y_px) - reach), min(image.shape[0], int(y_px) + reach + 1)):
        for column in range(max(0, int(x_px) - reach), min(image.shape[1], int(x_px) + reach + 1)):
            if lengths[row, column] < far:
                continue
            dx, dy = (column - x_px) / radius_px, (row - y_px) / radius_px
            r = np.sqrt(dx * dx + dy * dy)
            inside = min(1.0, max(0.0, (1.0 - r) * radius_px / 1.5))
            if inside <= 0.0:
                continue
            dark = 1.0 - 0.6 * r**3
            # The ring is bright on the side of the lamp and on the far side.
            ring = 0.28 * light * np.exp(-(((r - 0.92) / 0.04) ** 2)) * (0.25 + 0.75 * (dx + dy) ** 2 * 0.5)
            glint = 1.2 * light * np.exp(-(((dx + 0.25) ** 2 + (dy + 0.3) ** 2) / 0.008))
            for channel in range(3):
                value = image[row, column, channel]
                image[row, column, channel] = value + inside * (value * dark + ring + glint - value)
            cover[row, column] += 0.7 * inside * (1.0 - cover[row, column])
