"""Calibration boards and their detection in an image: ChArUco, asymmetric and symmetric dot grids.

Board frame: the board is the plane z = 0, x along its columns, y along its rows [m].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError

_DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
DARK, UNEVEN = 0.6, 0.12  # of the paper around a dot: the dot's brightness, and the paper's unevenness
MIN_POINTS = 8  # fewer points do not determine the pose of a view well
BOARD_SYNTAX = (
    "charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM[:DICTIONARY], dots:COLUMNSxROWS:PITCH_MM (asymmetric, pitch "
    "between rows of one column, as OpenCV counts it) or symmetric_dots:COLUMNSxROWS:PITCH_MM"
)


# Bias of detected points that is common to many views, at the border of the image [px]. No residual shows it,
# since camera and poses absorb it. Corners are refined between edges that stay straight under perspective;
# the centre of a dot's image is not the image of its centre. These sizes cover the errors of simulated
# calibrations: see `bench_calibration`.
CORNER_BIAS_PX, DOT_BIAS_PX = 0.02, 0.11


class BoardView(NamedTuple):
    """A board in one image: point ids (n,), points (n, 3) [m] in the board's frame, pixels (n, 2).

    `bias_px` is the size of the error that is common to the points of many views.
    """

    stamp_ns: int
    ids: npt.NDArray[np.int64]
    points: Array
    pixels: Array
    bias_px: float = DOT_BIAS_PX


class Board(Protocol):
    """Interface of a calibration board."""

    @property
    def has_orientation(self) -> bool:
        """Whether the board looks different if it is rotated by half a turn."""

    def find(self, image: npt.NDArray[np.uint8], stamp_ns: int) -> BoardView | None:
        """The board in a grey or colour image; None if it is not found."""


@dataclass(frozen=True)
class CharucoBoard:
    """A chessboard of `columns` x `rows` squares with ArUco markers in the white ones (OpenCV's layout)."""

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_250"

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise PerceptionError(f"a ChArUco board has at least 3x3 squares, not {self.columns}x{self.rows}")
        if not 0 < self.marker < self.square:
            raise PerceptionError(
                f"a marker must be smaller than its square and larger than 0 m, not {self.marker} in "
                f"{self.square} m"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise PerceptionError(f"OpenCV has no marker dictionary '{self.dictionary}'; DICT_4X4_250 is one")

    @property
    def has_orientation(self) -> bool:
        """True, since the markers identify every corner."""
        return True

    def opencv(self) -> Any:
        """OpenCV's object of the board, which draws and detects it."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    def find(self, image: npt.NDArray[np.uint8], stamp_ns: int = 0) -> BoardView | None:
        """Corners of the squares between detected markers, to a fraction of a pixel."""
        grey = _grey(image)
        board = self.opencv()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is None or len(ids) < MIN_POINTS:
            return None
        order = ids.ravel().astype(np.int64)
        points = np.asarray(board.getChessboardCorners(), dtype=np.float64)[order]
        pixels = _refined(grey, corners.reshape(-1, 2), points, (self.square - self.marker) / 2)
        return BoardView(stamp_ns, order, points, pixels, CORNER_BIAS_PX)


@dataclass(frozen=True)
class DotGrid:
    """A grid of dark dots on white, `columns` x `rows` as OpenCV's findCirclesGrid counts them."""

    columns: int
    rows: int
    pitch: float
    asymmetric: bool = True

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not self.pitch > 0:
            raise PerceptionError(
                f"a dot grid has at least 3x3 dots and a pitch above 0 m, not {self.columns}x{self.rows}, "
                f"{self.pitch} m"
            )

    @property
    def has_orientation(self) -> bool:
        """False for a symmetric grid, which looks the same if it is rotated by half a turn."""
        return self.asymmetric

    @property
    def points(self) -> Array:
        """All dots (n, 3) [m], row by row."""
        rows, columns = np.mgrid[: self.rows, : self.columns]
        x = (2 * columns + rows % 2) if self.asymmetric else columns
        flat = np.stack([x.ravel(), rows.ravel(), np.zeros(x.size)], axis=1)
        return np.asarray(flat * self.pitch, dtype=np.float64)

    def find(self, image: npt.NDArray[np.uint8], stamp_ns: int = 0) -> BoardView | None:
        """The dots, if all of them are in the image."""
        layout = cv2.CALIB_CB_ASYMMETRIC_GRID if self.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        grey = _grey(image)
        detector = cv2.SimpleBlobDetector.create(_blobs(grey.size))
        found, centres = cv2.findCirclesGrid(
            grey, (self.columns, self.rows), None, layout | cv2.CALIB_CB_CLUSTERING, detector
        )
        dots = _printed(grey, detector.detect(grey)) if not found else ()
        if len(dots) >= self.columns * self.rows:
            # Without a detector, OpenCV takes the dots themselves; its type stub does not declare that.
            found, centres = cv2.findCirclesGrid(  # type: ignore[call-overload]
                dots, (self.columns, self.rows), layout | cv2.CALIB_CB_CLUSTERING, None, _FINDER
            )
        if not found:
            return None
        pixels = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
        return BoardView(stamp_ns, np.arange(len(pixels)), self.points, pixels)


def board_from_text(text: str) -> Board:
    """The board described by a text such as `charuco:12x9:3.0:2.2`.

    Raises PerceptionError with the syntax for any other text.
    """
    kind, *fields = text.split(":")
    try:
        columns, rows = (int(number) for number in fields[0].split("x"))
        lengths = [float(number) * 1e-3 for number in fields[1 : 3 if kind == "charuco" else 2]]
        if kind == "charuco" and len(lengths) == 2 and len(fields) <= 4:
            return CharucoBoard(columns, rows, lengths[0], lengths[1], *fields[3:])
        if kind in ("dots", "symmetric_dots") and len(fields) == 2:
            return DotGrid(columns, rows, lengths[0], asymmetric=kind == "dots")
    except (IndexError, ValueError) as error:
        if isinstance(error, PerceptionError):
            raise
    raise PerceptionError(f"'{text}' is not a board; a board is {BOARD_SYNTAX}")


def _grey(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _refined(grey: npt.NDArray[np.uint8], corners: Any, points: Array, clear: float) -> Array:
    """Corners refined in a window that ends `clear` [m] from the corner, where the nearest marker begins."""
    # The distance to the nearest neighbour, in pixels and in metres, gives the scale of the image there.
    apart_px = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    np.fill_diagonal(apart, np.inf)
    nearest, row = apart.argmin(axis=1), np.arange(len(points))
    scale = apart_px[row, nearest] / apart[row, nearest]
    half_px = np.clip(0.75 * scale * clear, 2, 11).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    refined = np.array(corners, dtype=np.float32)
    for half in np.unique(half_px):
        chosen = half_px == half
        found = cv2.cornerSubPix(grey, refined[chosen].copy(), (int(half), int(half)), (-1, -1), stop)
        refined[chosen] = np.asarray(found).reshape(-1, 2)
    return np.asarray(refined, dtype=np.float64)


_FINDER = cv2.CirclesGridFinderParameters()


def _printed(grey: npt.NDArray[np.uint8], blobs: Sequence[cv2.KeyPoint]) -> npt.NDArray[np.float32]:
    """Centres (n, 1, 2) of the blobs that are ink on paper: much darker than an even ring around them.

    The surroundings of the board may show more blobs than the board.
    """
    ring = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=-1)
    kept = []
    for blob in blobs:
        centre, radius = np.array(blob.pt), 0.5 * blob.size
        around = np.rint(centre + 1.7 * radius * ring).astype(int)
        if (around < 0).any() or (around >= grey.shape[::-1]).any():
            continue
        paper = grey[around[:, 1], around[:, 0]].astype(float)
        ink = float(grey[round(blob.pt[1]), round(blob.pt[0])])
        if ink < DARK * paper.min() and paper.std() < UNEVEN * paper.mean():
            kept.append(blob.pt)
    return np.array(kept, dtype=np.float32).reshape(-1, 1, 2)


def _blobs(image_size: int) -> Any:
    settings = cv2.SimpleBlobDetector.Params()
    settings.minArea, settings.maxArea = 12.0, image_size / 50
    settings.filterByConvexity = settings.filterByInertia = False
    settings.minDistBetweenBlobs = 3.0
    return settings
