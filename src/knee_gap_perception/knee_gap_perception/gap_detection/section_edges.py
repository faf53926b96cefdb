"""Measurement of the opening's edges in the present image, at the section where an instrument would pass.

The tracked points are the same in all images; the edges are not. In each image, the borders of the tissue
beside the points are measured. The largest circle between them, centred on the line across the opening, gives
the apparent width: tissue beside that line counts as far as an instrument of that width reaches.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Image, Mask
from knee_gap_core.values.edges import EdgeState, SectionEdges
from knee_gap_perception.camera.camera import Camera, bearing_jacobian
from knee_gap_perception.gap_detection.section_kernel import circle_between, last_below
from knee_gap_perception.image.field_of_view import FieldOfView

ROW_STEP = 4.0  # [px] along the opening between the lines on which its borders are searched
BEYOND = 24  # [px] beyond a tracked point up to which its border is searched
# Threshold where tissue begins, as a fraction of the way from the gap's brightness to the tissue's. Light
# grazes smooth bone beside its contour, so tissue is dim there: one half would place the border inside it.
TISSUE_BEGINS = 0.25
# The same fractions for the earliest and the latest beginning of tissue.
EARLIEST, LATEST = 0.12, 0.5
LEAST_STEP = 10.0  # [grey levels] least step from gap to tissue at a border
SLOWEST_TURN = np.radians(4.0)  # largest rotation of the direction across from one image to the next
TURN_SHARE = 0.3  # fraction of the difference by which it rotates
JUMP = 8.0  # [px] largest motion of an edge relative to its point from one image to the next
JUMP_RATE = 60.0  # [px/s] growth of that limit while the edge is not visible
HELD = 0.5  # [s] after which an edge that stays at another position is accepted
FLOOR = 1.0  # [px] standard deviation of a perfectly sharp edge
WIDTH_SHARE = 0.3  # standard deviation of an edge relative to the width of its border
BOUND = 3.0  # standard deviations
MARGIN = 3.0  # [px] from the border of the field of view, within which an edge counts as at the border
FOREIGN_SHARE = 0.3  # largest covered fraction of the lines of an instrument's width
STATIONS = 3  # sections to either side in a profile
STATION_STEP = 0.6  # of the circle's radius between two of them


class Borders(NamedTuple):
    """Border of the tissue on lines across the opening, on one side: distances (n,) from the centre [px].

    `earliest` and `latest` (n,) enclose `place`. `known` is false for a line whose border is not visible,
    because it is covered or outside the search range; the border then lies at `place` or farther out.
    """

    place: Array
    earliest: Array
    latest: Array
    known: Mask


class Circle(NamedTuple):
    """Largest circle with its centre on a line: offset of the centre along the line, and radius [px].

    `contacts` (2,): the lines on which it touches either border.
    """

    offset: float
    radius: float
    contacts: tuple[int, int]


def largest_circle(rows: Array, borders: tuple[Array, Array], at: float = 0.0) -> Circle:
    """The largest circle with its centre on the line at `at`, between borders (n,) on lines at `rows` (n,).

    Borders are distances from the line through the section's centre to either side, both positive outwards;
    all lengths in pixels.
    """
    offset, radius, *contacts = circle_between(rows, borders[0], borders[1], at)
    return Circle(offset, radius, (contacts[0], contacts[1]))


@dataclass(frozen=True)
class _Strip:
    """Brightness (rows, columns) on lines across the opening, and the lines' places along it [px].

    Column `middle` lies on the line along the opening through the section's centre.
    """

    values: Image
    rows: Array
    middle: int


class SectionEdgeFinder:
    """Measures the edges beside two tracked points, image by image."""

    def __init__(self, centre: Array, across: Array, points: Array) -> None:
        """Start at the section around `centre` (2,) [px], with the unit vector (2,) across the opening.

        `points` (2, 2) [px] are the tracked points beside it, in the same image.
        """
        self._across = across
        along = np.array([-across[1], across[0]])
        middle = points.mean(axis=0)
        self._shift = float((centre - middle) @ along)
        self._span = float(np.linalg.norm(points[1] - points[0]))
        self._offset = float((centre - middle) @ across)
        self._insets: Array | None = None
        self._seen_ns = 0
        # Where the edges of the last image were that was not believed.
        self._elsewhere: Array | None = None
        self._circle: Circle | None = None
        self._settled = False

    def find(
        self,
        stamp_ns: int,
        grey: Image,
        foreign: Mask,
        scale: float,
        field: FieldOfView,
        camera: Camera,
        points: Array,
        *,
        profile: bool = False,
        origin: Array | None = None,
    ) -> tuple[SectionEdges, tuple[SectionEdges, ...]]:
        """The edges at the section, and those at more sections along the opening if `profile`.

        `grey` (h, w) is the image exposed at a stamp [ns]; `foreign` the mask of instruments and glare,
        reduced by `scale`, of the image or of its part from the pixel `origin` (2,) on; `points` (2, 2)
        [px] the tracked points in the image.
        """
        edges: SectionEdges = SectionEdges()
        more: tuple[SectionEdges, ...] = ()
        for _ in range(1 if self._settled else 4):
            centre = self._centre(points)
            found = self._borders(grey, foreign, scale, origin, centre, points, profile)
            if found is None:
                return SectionEdges(), ()
            rows, borders = found
            circle = largest_circle(rows, (borders[0].place, borders[1].place))
            edges = self._edges(circle, rows, borders, centre, field, camera)
            if not self._settled:
                self._turn(circle, rows, borders, 1.0)
        self._settled = True
        insets = self._insets_of(circle, points, centre)
        if edges.seen and not self._plausible(stamp_ns, insets):
            return SectionEdges(), ()
        if edges.seen:
            self._insets, self._seen_ns, self._circle = insets, stamp_ns, circle
            self._turn(circle, rows, borders, TURN_SHARE)
            if profile:
                more = self._profile(circle, rows, borders, centre, field, camera)
        return edges, more

    def _centre(self, points: Array) -> Array:
        """Present centre of the section (2,) [px]: it keeps its position between the points."""
        along = np.array([-self._across[1], self._across[0]])
        grown = float(np.linalg.norm(points[1] - points[0])) / max(self._span, 1.0)
        shift = self._shift * float(np.clip(grown, 0.3, 3.0))
        centre = points.mean(axis=0) + shift * along + self._offset * self._across
        if self._circle is not None and self._insets is not None:
            # Midway between the edges, at their offsets from the points in the last image.
            across = (points - centre) @ self._across + np.array([1.0, -1.0]) * self._insets
            centre = centre + across.mean() * self._across
        return np.asarray(centre)

    def _borders(
        self,
        grey: Image,
        foreign: Mask,
        scale: float,
        origin: Array | None,
        centre: Array,
        points: Array,
        profile: bool,
    ) -> tuple[Array, tuple[Borders, Borders]] | None:
        """Lines (n,) along the opening and the borders on either side; None if none can be measured."""
        reaches = np.abs((points - centre) @ self._across) + BEYOND
        if not (np.isfinite(reaches).all() and reaches.max() < 2000.0):
            return None
        half = float(reaches.max())
        extent = half * (1.0 + STATIONS * STATION_STEP) if profile else half
        strip = self._strip(grey, centre, half, extent)
        gap = self._gap_level(strip, half)
        along = np.array([-self._across[1], self._across[0]])
        sides = []
        for index, sign in enumerate((-1.0, 1.0)):
            tissue = _tissue_level(grey, points[index])
            if tissue - gap < LEAST_STEP:
                return None
            length = int(reaches[index])
            place, earliest, latest = (
                last_below(strip.values, strip.middle, int(sign), length, gap + share * (tissue - gap))
                for share in (TISSUE_BEGINS, EARLIEST, LATEST)
            )
            ends = centre + sign * place[:, None] * self._across + strip.rows[:, None] * along
            within = ends if origin is None else ends - origin
            column, row = np.rint((within + 0.5) * scale - 0.5).astype(int).T
            covered = foreign[row.clip(0, foreign.shape[0] - 1), column.clip(0, foreign.shape[1] - 1)]
            known = ~covered & (place < length - 2)
            sides.append(Borders(place, np.minimum(earliest, place), np.maximum(latest, place), known))
        return strip.rows, (sides[0], sides[1])

    def _strip(self, grey: Image, centre: Array, half: float, extent: float) -> _Strip:
        count = int(np.ceil(extent / ROW_STEP))
        width = int(np.ceil(half)) + 1
        along = np.array([-self._across[1], self._across[0]])
        matrix = np.stack([self._across, ROW_STEP * along], axis=1)
        shift = centre - matrix @ np.array([width, count], float)
        values = cv2.warpAffine(
            grey,
            np.concatenate([matrix, shift[:, None]], axis=1),
            (2 * width + 1, 2 * count + 1),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        smooth = np.asarray(cv2.blur(values, (3, 3)), np.uint8)
        return _Strip(smooth, ROW_STEP * np.arange(-count, count + 1.0), width)

    def _gap_level(self, strip: _Strip, half: float) -> float:
        """Brightness of the opening's middle."""
        radius = 0.3 * half if self._circle is None else 0.5 * self._circle.radius
        reach = max(int(radius), 4)
        rows = np.abs(strip.rows) <= max(radius, ROW_STEP)
        return _median(strip.values[rows, strip.middle - reach : strip.middle + reach + 1])

    def _turn(self, circle: Circle, rows: Array, borders: tuple[Borders, Borders], share: float) -> None:
        """Rotate the direction across towards the line between the circle's two contacts."""
        first, second = circle.contacts
        apart = np.array(
            [borders[0].place[first] + borders[1].place[second], rows[second] - rows[first]], float
        )
        angle = float(np.arctan2(apart[1], apart[0]))
        if self._settled:
            angle = float(np.clip(share * angle, -SLOWEST_TURN, SLOWEST_TURN))
        cosine, sine = np.cos(angle), np.sin(angle)
        along = np.array([-self._across[1], self._across[0]])
        turned = cosine * self._across + sine * along
        self._across = turned / np.linalg.norm(turned)

    def _edges(
        self,
        circle: Circle,
        rows: Array,
        borders: tuple[Borders, Borders],
        centre: Array,
        field: FieldOfView,
        camera: Camera,
        at: float = 0.0,
    ) -> SectionEdges:
        along = np.array([-self._across[1], self._across[0]])
        place = centre + at * along + circle.offset * self._across
        pixels = place + np.array([[-1.0], [1.0]]) * circle.radius * self._across
        within = np.abs(rows - at) <= circle.radius
        states, deviations = [], []
        for index in (0, 1):
            side, contact = borders[index], circle.contacts[index]
            width = float(side.latest[contact] - side.earliest[contact])
            deviations.append(float(np.hypot(FLOOR, WIDTH_SHARE * width)))
            if field.depth_inside(pixels[index]) < MARGIN:
                states.append(EdgeState.AT_BORDER)
            elif not side.known[contact] or np.mean(~side.known[within]) > FOREIGN_SHARE:
                states.append(EdgeState.UNKNOWN)
            else:
                states.append(EdgeState.SEEN)
        bearings = camera.bearings(pixels)
        steps = [float(np.linalg.norm(bearing_jacobian(camera, pixel) @ self._across)) for pixel in pixels]
        angles = np.array(deviations) * steps
        if not (np.isfinite(bearings).all() and np.isfinite(angles).all()) or circle.radius < 2.0:
            return SectionEdges()
        missing = np.array([state is EdgeState.UNKNOWN for state in states])
        bearings[missing], pixels[missing] = np.nan, np.nan
        return SectionEdges(
            states=(states[0], states[1]),
            pixels=pixels,
            bearings=bearings,
            deviations=np.where(missing, np.nan, angles),
            error=float("nan") if missing.any() else float(BOUND * angles.max()),
        )

    def _insets_of(self, circle: Circle, points: Array, centre: Array) -> Array:
        """Distance (2,) [px] of each tracked point beyond its edge, across the opening."""
        places = (points - centre) @ self._across
        return np.array(
            [circle.offset - circle.radius - places[0], places[1] - circle.offset - circle.radius]
        )

    def _plausible(self, stamp_ns: int, insets: Array) -> bool:
        """Whether the edges are close to those expected from the last image."""
        if self._insets is None:
            return True
        since = 1e-9 * (stamp_ns - self._seen_ns)
        before, self._elsewhere = self._elsewhere, None
        if np.abs(insets - self._insets).max() < JUMP + JUMP_RATE * min(since, HELD):
            return True
        self._elsewhere = insets
        stays = before is not None and np.abs(insets - before).max() < JUMP
        return since > HELD and bool(stays)

    def _profile(
        self,
        circle: Circle,
        rows: Array,
        borders: tuple[Borders, Borders],
        centre: Array,
        field: FieldOfView,
        camera: Camera,
    ) -> tuple[SectionEdges, ...]:
        sections = []
        for station in range(-STATIONS, STATIONS + 1):
            at = station * STATION_STEP * circle.radius
            there = largest_circle(rows, (borders[0].place, borders[1].place), at)
            edges = self._edges(there, rows, borders, centre, field, camera, at)
            sections.append(edges if edges.seen else SectionEdges())
        return tuple(sections)


def _tissue_level(grey: Image, pixel: Array) -> float:
    """Brightness of the tissue around a tracked point."""
    column, row = np.rint(pixel).astype(int)
    patch = grey[max(0, row - 8) : max(0, row + 9), max(0, column - 8) : max(0, column + 9)]
    return _median(patch) if patch.size else 0.0


def _median(values: Image) -> float:
    """Median, NaN of no values: numpy's takes five times as long for so few."""
    ordered = np.sort(values, axis=None)
    middle = ordered.size // 2
    if ordered.size % 2:
        return float(ordered[middle])
    return 0.5 * (float(ordered[middle - 1]) + float(ordered[middle])) if ordered.size else float("nan")
