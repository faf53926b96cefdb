"""Reader of Motive takes exported as CSV, format versions 1.20 to 1.25: poses in metres with Z up.

The first line contains keys and values (units, rotation type, start time). The next rows give, for each
column, its type, its body's name, its id, sometimes its parent, and whether it is rotation, position or
error. A row with the axes, which starts with `Frame`, is followed by the frames. An empty cell is a body that
was not tracked; it becomes NaN. Euler angles are in degrees about the body's own axes, one after the other in
the order of the rotation type (the vendor calls this relative).
"""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import permutations
from pathlib import Path
from textwrap import shorten

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from knee_gap_core.user_files import FileError, read_bytes
from knee_gap_core.values.arrays import Array
from knee_gap_core.values.poses import BodyPose
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.trackers.body_source import BodyFrame, UnknownBodyError
from knee_gap_perception.trackers.up_axis import position_z_up, quaternion_z_up

METRES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
EULER_ORDERS = tuple("".join(order) for order in permutations("XYZ"))
BODY_TYPE = "rigid body"
# Tolerance for times rounded to a millisecond, and for the last digit of a rate over a long take [s].
ROUNDED_TIME = 0.6e-3
# An hour of ten bodies at 240 Hz; the rows take some times as much memory.
MOST_BYTES = 512 << 20
# Largest number of a frame, and largest time [s].
MOST_FRAME_AND_TIME = 1e9
# Largest length of a message, since a broken file's cells can be of any length and contain line breaks.
MOST_WORDS = 300
LABELS = ("type", "name", "id", "parent")

# Markers of AM and PM in the languages of Motive's machines.
MORNING = {"am", "vorm", "上午", "午前", "오전", "πμ", "dop", "de"}
EVENING = {"pm", "nachm", "下午", "午後", "오후", "μμ", "odp", "du"}


class TakeError(PerceptionError):
    """A file that is not a take exported by Motive, or is incomplete; the message names the place."""


@dataclass(frozen=True, eq=False)
class TakeBody:
    """One rigid body over a take of n frames, Z up; NaN if it was not tracked.

    `position` (n, 3) [m], `quaternion_xyzw` (n, 4) of unit length, `mean_error` (n,) [m], NaN if it was not
    exported.
    """

    name: str
    id: str
    position: Array
    quaternion_xyzw: Array
    mean_error: Array

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Whether the body was tracked, (n,)."""
        numbers = np.hstack([self.position, self.quaternion_xyzw])
        return np.asarray(np.isfinite(numbers).all(axis=1))


@dataclass(frozen=True, eq=False)
class Take:
    """One exported take: `time` (n,) [s] since its start, `frame` (n,) numbers, and its bodies.

    `start` is the capture's start by the clock of Motive's machine. The file does not contain its time zone,
    so it is marked as UTC here; None if it cannot be read. `exported_count` is the number of frames by the
    file's header.
    """

    version: str
    rate: float
    start: datetime | None
    start_text: str
    exported_count: int | None
    time: Array
    frame: npt.NDArray[np.int64]
    bodies: tuple[TakeBody, ...]

    def body(self, wanted: str) -> TakeBody:
        """Return a body by name or id. Raises UnknownBodyError with the list of bodies."""
        for body in self.bodies:
            if wanted in (body.name, body.id):
                return body
        known = ", ".join(f"'{body.name}'" for body in self.bodies)
        raise UnknownBodyError(f"the take has no rigid body '{wanted}'; it has: {known or 'none'}")

    def frames(self, start_ns: int) -> Iterator[BodyFrame]:
        """Yield each frame with stamps that start at `start_ns`; bodies that were not tracked are marked."""
        names = dict(enumerate((body.name for body in self.bodies), start=1))
        for index, time in enumerate(self.time):
            stamp_ns = start_ns + round(float(time) * 1e9)
            poses = tuple(
                BodyPose(
                    stamp_ns=stamp_ns,
                    position=body.position[index],
                    quaternion_xyzw=body.quaternion_xyzw[index],
                    name=body.name,
                    tracking_valid=bool(body.seen[index]),
                    mean_error=float(body.mean_error[index]),
                )
                for body in self.bodies
            )
            yield BodyFrame(stamp_ns, poses, names)


@dataclass(frozen=True)
class _BodyColumns:
    """Columns of one body."""

    name: str
    id: str
    rotation: tuple[int, ...]
    position: tuple[int, ...]
    error: int | None

    @property
    def indices(self) -> tuple[int, ...]:
        """All columns."""
        return (*self.rotation, *self.position, *(() if self.error is None else (self.error,)))


def read_take(path: Path, *, up_axis: str = "y", partial: bool = False) -> Take:
    """Read a take. A file that ends in the middle of a line is refused unless `partial` is set.

    Raises TakeError, with the line and the rule, if the file is not a take or is incomplete.
    """
    rows = _rows(path)
    try:
        header, columns, first = _header(rows)
        order, scale = _rotation_order(header, columns), _metres(header)
        needed = [0, 1, *(index for body in columns for index in body.indices)]
        width = max(len(_without_empty_end(row)) for row in rows[1:first])
        cells = _cells(rows[first:], first, width, needed, partial=partial)
    except TakeError as error:
        raise TakeError(f"{path.name}: {shorten(str(error), MOST_WORDS)}") from None
    if not len(cells):
        raise TakeError(f"{path.name}: the take has no frames")
    rate = _number(header["Export Frame Rate"]) if header.get("Export Frame Rate") else float("nan")
    time = _exact_times(cells[:, 1], cells[:, 0], rate)
    backwards = np.flatnonzero(~(np.diff(time) > 0))
    if len(backwards):
        line = first + int(backwards[0]) + 3
        raise TakeError(f"{path.name}: line {line}: its time does not follow that of the line before")
    count = header.get("Total Exported Frames", "")
    return Take(
        version=header["Format Version"],
        rate=rate,
        start=_start_time(header.get("Capture Start Time", "")),
        start_text=header.get("Capture Start Time", ""),
        exported_count=int(count) if count.isdecimal() and len(count) < 10 else None,
        time=time,
        frame=cells[:, 0].astype(np.int64),
        bodies=tuple(_body(cells, body, order, scale, up_axis) for body in columns),
    )


def _rows(path: Path) -> list[list[str]]:
    try:
        text = _decoded(read_bytes(path, MOST_BYTES))
    except FileError as error:
        raise TakeError(str(error)) from None
    first_line = re.split("[\r\n]", text, maxsplit=1)[0]
    delimiter = max(",;\t", key=first_line.count)
    # A sentinel row at the end: if it is not parsed as a row, the text ends inside a quoted cell.
    end = "" if text.endswith(("\n", "\r")) else "\n"
    try:
        rows = list(csv.reader(io.StringIO(f"{text}{end}{_END}", newline=""), delimiter=delimiter))
    except csv.Error as error:
        raise TakeError(f"{path.name}: not a take of Motive: {error}") from None
    is_quote_open = rows[-1] != [_END]
    rows = rows if is_quote_open else rows[:-1]
    if not rows or not rows[0] or rows[0][0].strip() != "Format Version":
        raise TakeError(f"{path.name}: not a take of Motive: its first line must start with 'Format Version'")
    if is_quote_open or end:
        # Motive ends every line; without this check, half a number at the end would be read as a whole one.
        rows[-1] = [*rows[-1][:-1], _CUT]
    return [row for row in rows if any(cell.strip() for cell in row)]


_CUT = "\x00cut"
_END = "\x00end"


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _header(rows: list[list[str]]) -> tuple[dict[str, str], list[_BodyColumns], int]:
    """Keys and values, the bodies' columns, and the index of the first row of data."""
    keys = [cell.strip() for cell in rows[0]]
    header = dict(zip(keys, [*keys[1:], ""], strict=True))
    axes_index = next((index for index, row in enumerate(rows[:12]) if row[0].strip() == "Frame"), None)
    if axes_index is None:
        raise TakeError("no row that starts with 'Frame' in its first lines")
    if axes_index < 4:
        raise TakeError("the rows with types, names and ids are missing: export with header information")
    above = rows[1:axes_index]
    labelled = {
        row[1].strip().lower(): row for row in above if len(row) > 1 and row[1].strip().lower() in LABELS
    }
    kinds, axes = above[-1], rows[axes_index]
    # Old versions do not label the rows.
    types, names, ids = (
        labelled.get(label, [] if labelled else above[index]) for index, label in enumerate(LABELS[:3])
    )
    if not names:
        raise TakeError("the row with the names is missing: export with header information")
    turning = {_cell(names, index) for index, kind in enumerate(kinds) if kind.strip().lower() == "rotation"}
    columns: dict[str, dict[str, int]] = {}
    identity: dict[str, str] = {}
    for index in range(2, len(axes)):
        name = _cell(names, index)
        # Without a row of types, columns with a rotation belong to a body.
        if _cell(types, index).lower() != BODY_TYPE if types else name not in turning:
            continue
        identity.setdefault(name, _cell(ids, index))
        kind, axis = _cell(kinds, index), _cell(axes, index)
        key = "error" if "error" in kind.lower() else f"{kind.lower()} {axis}"
        if key in columns.setdefault(name, {}):
            raise TakeError(
                f"two columns are named '{kind} {axis}' of '{name}': bodies must have different names"
            )
        columns[name][key] = index
    bodies = [_columns_of(name, identity[name], found) for name, found in columns.items()]
    return header, bodies, axes_index + 1


def _cell(row: list[str], index: int) -> str:
    """Text of a cell on one line, empty if there is none."""
    return " ".join(row[index].split()) if index < len(row) else ""


def _columns_of(name: str, identity: str, found: dict[str, int]) -> _BodyColumns:
    rotation = tuple(found[f"rotation {axis}"] for axis in "XYZW" if f"rotation {axis}" in found)
    position = tuple(found[f"position {axis}"] for axis in "XYZ" if f"position {axis}" in found)
    if len(position) != 3 or len(rotation) not in (3, 4):
        raise TakeError(f"the columns of '{name}' are not a rotation and a position, but {', '.join(found)}")
    return _BodyColumns(name, identity, rotation, position, found.get("error"))


def _rotation_order(header: dict[str, str], bodies: list[_BodyColumns]) -> str | None:
    """Order of the Euler angles, None for quaternions; four numbers are a quaternion in any case."""
    kind = header.get("Rotation Type", "")
    if not kind and all(len(body.rotation) == 4 for body in bodies):
        return None
    if kind.upper() in EULER_ORDERS:
        return kind.upper()
    if kind.lower() != "quaternion":
        known = ", ".join(("Quaternion", *EULER_ORDERS))
        raise TakeError(f"the rotation type must be one of {known}, not '{kind}'")
    return None


def _metres(header: dict[str, str]) -> float:
    unit = header.get("Length Units", "")
    if unit.lower() not in METRES:
        raise TakeError(f"the length units must be Meters, Centimeters or Millimeters, not '{unit}'")
    space = header.get("Coordinate Space", "Global")
    if space.lower() != "global":
        raise TakeError(f"the coordinate space must be Global, not '{space}': export the take again")
    return METRES[unit.lower()]


def _cells(rows: list[list[str]], first: int, width: int, needed: list[int], *, partial: bool) -> Array:
    """Numbers of all frames (n, width): NaN if a cell is empty, not a number, or not needed."""
    cells = np.full((len(rows), width), np.nan)
    for index, row in enumerate(rows):
        line = first + index + 2
        if len(row) > width and not any(cell.strip() for cell in row[width:]):
            row = row[:width]
        is_cut = row[-1] == _CUT or len(row) < width
        if is_cut and index == len(rows) - 1:
            if not partial:
                raise TakeError(
                    f"line {line}: the file ends in the middle of it, after {index} whole frames; export it "
                    "again, or read these frames with --partial"
                )
            return cells[:index]
        if is_cut:
            raise TakeError(f"line {line}: {len(row)} cells instead of {width}")
        if len(row) > width:
            raise TakeError(
                f"line {line}: {len(row)} cells instead of {width}: numbers with a decimal comma in a "
                "file that is separated by commas; export it with a decimal point"
            )
        for column in needed:
            if row[column]:
                cells[index, column] = _number(row[column])
        if not (np.abs(cells[index, :2]) <= MOST_FRAME_AND_TIME).all():
            raise TakeError(f"line {line}: '{row[0]}', '{row[1]}' are not a frame number and a time")
    return cells


def _exact_times(time: Array, frame: Array, rate: float) -> Array:
    """Times [s] from the frame numbers if they agree, since some exports round times to milliseconds."""
    if not rate > 0.0:
        return time
    exact = frame / rate
    return exact if np.abs(time - exact).max() <= ROUNDED_TIME else time


def _without_empty_end(row: list[str]) -> list[str]:
    """The cells up to the last one that is not empty."""
    last = max((index for index, cell in enumerate(row) if cell.strip()), default=-1)
    return row[: last + 1]


def _number(text: str) -> float:
    """A number with a decimal point or comma; NaN for anything else."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return float(text.strip().replace(",", ".", 1))
    except ValueError:
        return float("nan")


def _body(cells: Array, columns: _BodyColumns, order: str | None, scale: float, up_axis: str) -> TakeBody:
    angles = cells[:, columns.rotation]
    if (order is None) != (len(columns.rotation) == 4):
        raise TakeError(
            f"'{columns.name}' has {len(columns.rotation)} numbers of rotation, which is not the stated type"
        )
    quaternion = _quaternions(angles, order)
    error = np.full(len(cells), np.nan) if columns.error is None else cells[:, columns.error] * scale
    return TakeBody(
        name=columns.name,
        id=columns.id,
        position=position_z_up(cells[:, columns.position] * scale, up_axis),
        quaternion_xyzw=quaternion_z_up(quaternion, up_axis),
        mean_error=error,
    )


def _quaternions(angles: Array, order: str | None) -> Array:
    """Unit quaternions (n, 4); NaN if a number is missing or it is not a rotation."""
    result = np.full((len(angles), 4), np.nan)
    whole = np.isfinite(angles).all(axis=1)
    if order is None:
        norms = np.linalg.norm(angles, axis=1)
        # Six decimals are written; a norm that differs from 1 by more than rounding is not a rotation.
        whole &= np.abs(norms - 1.0) < 1e-3
        result[whole] = angles[whole] / norms[whole, None]
    elif whole.any():
        # The columns are X, Y, Z, whatever the order of the rotations.
        turned = angles[whole][:, ["XYZ".index(axis) for axis in order]]
        result[whole] = Rotation.from_euler(order, turned, degrees=True).as_quat()
    return result


def _start_time(text: str) -> datetime | None:
    """Start of the capture from a localised text, such as `2019-09-18 04.30.02.695 PM`."""
    found = re.search(
        r"(\d{4})\D(\d{1,2})\D(\d{1,2})(\D+)(\d{1,2})\D(\d{2})\D(\d{2})(?:\D(\d{1,6}))?(.*)", text
    )
    if found is None:
        return None
    year, month, day, between, hour, minute, second, fraction, rest = found.groups()
    noon = {re.sub(r"[\W\d_]", "", part) for part in (between.lower(), rest.lower())} - {"", "t"}
    hour_of_day = int(hour)
    if noon & EVENING:
        hour_of_day = hour_of_day % 12 + 12
    elif noon & MORNING:
        hour_of_day %= 12
    elif noon:
        return None
    microsecond = int((fraction or "0").ljust(6, "0"))
    try:
        return datetime(
            int(year), int(month), int(day), hour_of_day, int(minute), int(second), microsecond, tzinfo=UTC
        )
    except ValueError:
        return None
