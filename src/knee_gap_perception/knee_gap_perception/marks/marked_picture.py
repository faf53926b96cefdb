"""The marks of one picture: field of view, gap, instruments, glare, and whether it shows a gap."""

import dataclasses
from collections.abc import Mapping
from enum import StrEnum

import cv2
import numpy as np

from knee_gap_core.values.arrays import Array, Mask

Box = tuple[float, float, float, float]


class Decision(StrEnum):
    """Whether a picture shows an opening that one looks through, past two edges, to something farther."""

    GAP = "gap"
    NO_GAP = "no gap"
    UNCLEAR = "unclear"  # not scored


class Region(StrEnum):
    """What a polygon encloses."""

    GAP = "gap"
    INSTRUMENT = "instrument"  # all that is made: instruments, cannulas, sutures, anchors
    GLARE = "glare"  # clipped: the lamp's reflection, or tissue that is overexposed
    DRAWN = "drawn"  # text and arrows on the picture
    UNCLEAR = "unclear"  # not scored: shade that may be an opening, tissue that hangs in one


@dataclasses.dataclass(frozen=True, eq=False)
class MarkedField:
    """The field of view: a disc (centre column and row, radius [px]) or a polygon (n, 2), cut by a box.

    A polygon stands where the picture was stretched, so that the disc is an ellipse. With the box alone the
    picture fills it. `box` is first column, first row, last column, last row [px].
    """

    disc: tuple[float, float, float] | None = None
    polygon: Array | None = None
    box: Box | None = None

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Pixels of an image of `shape` rows and columns that lie inside."""
        rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
        inside = np.ones(shape, bool)
        if self.disc is not None:
            x, y, radius = self.disc
            inside &= np.hypot(columns - x, rows - y) < radius
        if self.polygon is not None:
            inside &= filled([self.polygon], shape)
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            inside &= (columns >= x0) & (columns <= x1) & (rows >= y0) & (rows <= y1)
        return inside

    def rim(self, shape: tuple[int, int], count: int = 360) -> Array:
        """Points (n, 2) of the round border that lie inside an image of `shape` and the box; none without."""
        if self.disc is not None:
            x, y, radius = self.disc
            angle = np.arange(count) * (2.0 * np.pi / count)
            points = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
        elif self.polygon is not None:
            points = _along(self.polygon, count)
        else:
            return np.zeros((0, 2))
        x0, y0, x1, y1 = self.box or (0.0, 0.0, shape[1] - 1.0, shape[0] - 1.0)
        # A point on the very side shows no border.
        inside = (points > [x0 + 1.0, y0 + 1.0]) & (points < [x1 - 1.0, y1 - 1.0])
        return np.asarray(points[inside.all(axis=1)])


@dataclasses.dataclass(frozen=True, eq=False)
class MarkedPicture:
    """Marks of one picture file, or of one frame of a video file (counted from 0).

    `sha256` is the file's. `source` names where the picture comes from, `kind` what it shows (knee, nose).
    `notch` is the angle [rad] of the notch about the centre of the disc, from the image's x to its y; None
    where none is seen.
    """

    file: str
    sha256: str
    width: int
    height: int
    source: str
    kind: str
    decision: Decision
    frame: int | None = None
    field: MarkedField | None = None
    notch: float | None = None
    regions: Mapping[Region, tuple[Array, ...]] = dataclasses.field(default_factory=dict)
    note: str = ""

    @property
    def name(self) -> str:
        """The file's name, and the frame's number of a video."""
        return self.file if self.frame is None else f"{self.file} frame {self.frame}"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    def polygons(self, region: Region) -> tuple[Array, ...]:
        """Polygons (n, 2) [px] of a region."""
        return self.regions.get(region, ())

    def mask(self, region: Region) -> Mask:
        """Pixels (height, width) inside any polygon of a region and, if it is marked, inside the field."""
        inside = filled(self.polygons(region), self.shape)
        return inside if self.field is None else inside & self.field.mask(self.shape)

    def scored(self) -> Mask:
        """Pixels (height, width) of the field in which a prediction can be right or wrong."""
        field_mask = np.ones(self.shape, bool) if self.field is None else self.field.mask(self.shape)
        return field_mask & ~self.mask(Region.UNCLEAR)


def filled(polygons: tuple[Array, ...] | list[Array], shape: tuple[int, int]) -> Mask:
    """Pixels of an image of `shape` rows and columns inside any polygon (n, 2) [px]."""
    image = np.zeros(shape, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(image, [np.rint(polygon * 16).astype(np.int32)], (1,), shift=4)
    return image > 0


def _along(polygon: Array, count: int) -> Array:
    """Points (count, 2) evenly spread along a closed polygon."""
    closed = np.concatenate([polygon, polygon[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.linspace(0.0, length[-1], count, endpoint=False)
    return np.stack([np.interp(at, length, closed[:, axis]) for axis in (0, 1)], axis=1)
