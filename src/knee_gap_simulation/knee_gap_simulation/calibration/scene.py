"""Images of a calibration board on a speckled table, seen by a scope that can rotate in its camera head."""

from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.scope.notch import Notch

ByteImage = npt.NDArray[np.uint8]

TEXTURE_PX_PER_M = 26_000  # 0.038 mm: about a pixel of the picture at the working distance
TABLE_MARGIN = 0.030  # [m] of table around the board
WORKING_DISTANCE = 0.024
NOISE_FRAMES = 6  # generated once, then rolled at random: noise is the slowest part of an image
TINT_BGR = (0.86, 0.93, 1.0)


class Board(Protocol):
    """Interface of a board. Its frame has x along the columns and y along the rows [m]."""

    @property
    def text(self) -> str:
        """The board as calibration commands take it."""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""

    def texture(self, rng: np.random.Generator) -> tuple[npt.NDArray[np.float32], float, Array]:
        """Reflectance (h, w), its scale [px/m], and the pixel (2,) of the board's origin."""


@dataclass(frozen=True)
class DotBoard:
    """OpenCV's asymmetric grid of dots on a white card. Frame: the first dot is the origin; as ChessBoard."""

    columns: int = 4
    rows: int = 11
    pitch: float = 0.0013
    dot: float = 0.0004  # radius
    card: float = 0.0030  # white around the outer dots

    @property
    def text(self) -> str:
        """The board as calibration commands take it."""
        return f"dots:{self.columns}x{self.rows}:{1e3 * self.pitch:g}"

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m], from the first dot to the last."""
        return (2 * self.columns - 1) * self.pitch, (self.rows - 1) * self.pitch

    def texture(self, rng: np.random.Generator) -> tuple[npt.NDArray[np.float32], float, Array]:
        """Reflectance (h, w), its scale [px/m], and the pixel (2,) of the first dot."""
        scale = float(TEXTURE_PX_PER_M)
        origin = round((TABLE_MARGIN + self.card) * scale)
        width, height = (round(side * scale) + 2 * origin for side in self.size)
        table = _table((height, width), scale, rng)
        card = slice(round(TABLE_MARGIN * scale), -round(TABLE_MARGIN * scale))
        table[card, card] = 0.85
        y, x = np.mgrid[:height, :width].astype(np.float32)
        for row in range(self.rows):
            for column in range(self.columns):
                centre = origin + scale * self.pitch * np.array([2 * column + row % 2, row])
                distance = np.hypot(x - centre[0], y - centre[1])
                inside = np.clip(self.dot * scale - distance + 0.5, 0.0, 1.0)
                table += (0.07 - table) * inside
        return cv2.GaussianBlur(table, (0, 0), 0.7).astype(np.float32), scale, np.full(2, float(origin))


def _table(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Speckles of the table's reflectance."""
    table = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 0.00025 * scale)
    return np.asarray(np.clip(0.45 + 0.12 * table / table.std(), 0.15, 0.8), dtype=np.float32)


@dataclass(frozen=True)
class ChessBoard:
    """OpenCV's ChArUco board. Frame: x along the columns, y along the rows, z away from the viewer [m]."""

    columns: int = 12
    rows: int = 9
    square: float = 0.0030
    marker: float = 0.0020
    dictionary: str = "DICT_4X4_250"

    @property
    def text(self) -> str:
        """The board as calibration commands take it."""
        square_mm, marker_mm = 1e3 * self.square, 1e3 * self.marker
        return f"charuco:{self.columns}x{self.rows}:{square_mm:g}:{marker_mm:g}:{self.dictionary}"

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.columns * self.square, self.rows * self.square

    def texture(self, rng: np.random.Generator) -> tuple[npt.NDArray[np.float32], float, Array]:
        """Reflectance (h, w), its scale [px/m], and the pixel (2,) of the board's origin."""
        per_square = round(self.square * TEXTURE_PX_PER_M)
        scale = per_square / self.square
        margin = round(TABLE_MARGIN * scale)
        width, height = self.columns * per_square, self.rows * per_square
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        table = _table((height + 2 * margin, width + 2 * margin), scale, rng)
        ink = board.generateImage((width, height), marginSize=0)
        table[margin : margin + height, margin : margin + width] = np.where(ink > 127, 0.85, 0.07)
        # The board starts at the edge of the texture's first pixel, half a pixel from its centre.
        return cv2.GaussianBlur(table, (0, 0), 0.7).astype(np.float32), scale, np.full(2, margin - 0.5)


@dataclass(frozen=True)
class RotatedScope:
    """A scope whose shaft rotates in the camera head, to which the tracked body is fixed."""

    scope: Scope = field(default_factory=Scope)
    notch_angle: float = np.radians(-90.0)  # in the image, from x towards y, at rotation 0

    def body_to_lens(self, turn: float) -> Array:
        """``T_body_lens`` (4, 4) at a rotation about the shaft; its axes stay with the sensor."""
        shaft = self.scope.body_to_shaft()
        tilt = from_rotation_vectors([self.scope.oblique_angle, 0.0, 0.0], np.zeros(3))
        tip = shaft @ from_rotation_vectors([0.0, 0.0, turn], np.zeros(3)) @ tilt
        # The relay turns the picture by `turn` on the sensor: what the sensor calls x is the tip's x turned
        # back.
        return tip @ from_rotation_vectors([0.0, 0.0, -turn], np.zeros(3))


class BoardCamera:
    """Renders images of the board through the lens, with the light at its tip, noise and the notch."""

    def __init__(self, board: Board, lens: Lens, scope: RotatedScope, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 0x4243])
        self._texture, self._scale, self._origin = board.texture(self._rng)
        self._lens, self._scope = lens, scope
        # Only the square around the field of view is rendered; the rest stays black.
        left, top = (max(0, int(c - lens.radius_px) - 2) for c in (lens.centre_x_px, lens.centre_y_px))
        right, bottom = (int(c + lens.radius_px) + 4 for c in (lens.centre_x_px, lens.centre_y_px))
        self._crop = (slice(top, min(bottom, lens.height_px)), slice(left, min(right, lens.width_px)))
        pixels = lens.pixel_grid()[self._crop]
        self._bearings = np.nan_to_num(lens.bearings(pixels), nan=0.0).astype(np.float32)
        self._notch = Notch(lens, self._crop)
        self._stop = lens.field_stop()[self._crop]
        self._noise = self._rng.standard_normal((NOISE_FRAMES, *self._stop.shape), dtype=np.float32)

    def frame(self, T_board_lens: Array, turn: float) -> ByteImage:
        """Image (h, w, 3). Raises SimulationError if the lens is not in front of the board."""
        origin, rotation = T_board_lens[:3, 3].astype(np.float32), T_board_lens[:3, :3].astype(np.float32)
        if origin[2] >= 0:
            raise SimulationError(f"the lens must be in front of the board (z < 0), not at z = {origin[2]} m")
        ray = cv2.transform(self._bearings, rotation)
        towards = np.maximum(ray[..., 2], 0.05)
        depth = -origin[2] / towards
        x_px = (origin[0] + depth * ray[..., 0]) * self._scale + self._origin[0]
        y_px = (origin[1] + depth * ray[..., 1]) * self._scale + self._origin[1]
        light = cv2.remap(
            self._texture,
            x_px.astype(np.float32),
            y_px.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        shade = (np.float32(WORKING_DISTANCE) / depth) ** 2 * towards
        # Automatic exposure: it keeps the bright parts of the image at the same level.
        shade /= max(1e-6, float(np.percentile(shade[::16, ::16][self._stop[::16, ::16] > 0.5], 80)))
        light = cv2.GaussianBlur(light * shade, (0, 0), 0.8) * self._stop_at(turn)
        noise = np.roll(self._noise[self._rng.integers(NOISE_FRAMES)], self._rng.integers(len(light)), axis=0)
        noisy = np.clip(light + 0.008 * noise * np.sqrt(light + 0.05), 0.0, 1.0)
        display = 250 * cv2.pow(noisy, 1 / 1.8)
        image = np.zeros((self._lens.height_px, self._lens.width_px, 3), dtype=np.uint8)
        image[self._crop] = cv2.merge([cv2.convertScaleAbs(display, alpha=tint) for tint in TINT_BGR])
        return image

    def _stop_at(self, turn: float) -> npt.NDArray[np.float32]:
        """Fraction of the light that passes the field stop."""
        return np.asarray(self._stop * self._notch.light(self._scope.notch_angle + turn))
