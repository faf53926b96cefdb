"""Takes as Motive exports them: any variety from a table of rows, and three kinds that others recorded.

Positions and rotations are written in Motive's axes (Y up).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from recordings import BESIDE, RECORDED
from scipy.spatial.transform import Rotation

RECORDED_TAKES = "optitrack/motive_csv"
SINGLE_BODY = f"{RECORDED_TAKES}/hmv-s16_v121_quat_m_rb_rbm_marker.csv"
THREE_BODIES = f"{RECORDED_TAKES}/pathviewr_v123_quat_m_3rb.csv"
NO_BODY = f"{RECORDED_TAKES}/pathviewr_v123_xyz_m_unlabeled_dropouts.csv"

# Rotation, position [m] and error [m] of a body in a frame; a cell, or all of it, is None if not measured.
Pose = Sequence[float | None] | None


class Export:
    """Writes takes as Motive does, so that every variety can be had."""

    def __init__(
        self,
        *,
        version: str = "1.23",
        rotation: str = "Quaternion",
        unit: str = "Meters",
        parent: bool = False,
        timecode: bool = False,
        labels: bool = True,
        delimiter: str = ",",
        decimal: str = ".",
        newline: str = "\r\n",
        bodies: Sequence[str] = ("scope", "tibia"),
        start: str = "2021-04-18 02.24.27.730 PM",
    ) -> None:
        self.keys = {
            "Format Version": version,
            "Take Name": "a take",
            "Capture Frame Rate": "100.000000",
            "Export Frame Rate": "100.000000",
            "Capture Start Time": start,
            "Total Frames in Take": "3",
            "Total Exported Frames": "3",
            "Rotation Type": rotation,
            "Length Units": unit,
            "Coordinate Space": "Global",
        }
        self.parent, self.timecode, self.labels = parent, timecode, labels
        self.delimiter, self.decimal, self.newline = delimiter, decimal, newline
        self.bodies = bodies
        self.axes = ["X", "Y", "Z", "W"] if rotation == "Quaternion" else ["X", "Y", "Z"]

    def text(self, rows: Sequence[Sequence[Pose]], first_frame: int = 0) -> str:
        """`rows` hold per frame and body a rotation, a position and an error, or None where not seen."""
        width = len(self.axes) + 4
        before = ["", ""] + [""] * self.timecode

        def heading(label: str, cells: Sequence[str]) -> list[str]:
            return ["", label if self.labels else "", *before[2:], *cells]

        def per_body(values: Sequence[str]) -> list[str]:
            return [value for value in values for _ in range(width)]

        lines = [[cell for item in self.keys.items() for cell in item], []]
        lines.append(heading("Type", per_body(["Rigid Body"] * len(self.bodies)) + ["Marker"] * 3))
        lines.append(heading("Name", per_body(self.bodies) + ["Unlabeled 7"] * 3))
        lines.append(heading("ID", per_body([f"ID{name}" for name in self.bodies]) + ["C1"] * 3))
        if self.parent:
            lines.append(heading("Parent", [""] * (width * len(self.bodies) + 3)))
        kinds = ["Rotation"] * len(self.axes) + ["Position"] * 3 + ["Mean Marker Error"]
        lines.append([*before, *kinds * len(self.bodies), *["Position"] * 3])
        axes = [*self.axes, "X", "Y", "Z", ""] * len(self.bodies)
        lines.append(["Frame", "Time (Seconds)", *["TimeCode"] * self.timecode, *axes, "X", "Y", "Z"])
        for index, row in enumerate(rows, start=first_frame):
            cells = [str(index), self.number(index / 100), *["15:26:46:12.02"] * self.timecode]
            for body in row:
                cells += [""] * width if body is None else [self.number(value) for value in body]
            lines.append([*cells, "", "", ""])
        return self.newline.join(self.delimiter.join(line) for line in lines) + self.newline

    def number(self, value: float | None) -> str:
        return "" if value is None else f"{value:.6f}".replace(".", self.decimal)


@dataclass(frozen=True)
class KnownTake:
    """A take and what is in it: `gaps` in its frame numbers, the first position of the first body [m], Y up.

    `exported` is the number of frames that its header states; `seen` bounds how often the last body was seen.
    """

    path: Path
    version: str
    start: datetime
    names: tuple[str, ...]
    rate: float
    frames: int
    exported: int
    gaps: int = 0
    first_position: tuple[float, float, float] = (float("nan"),) * 3
    seen: tuple[int, int] = (0, 0)


def single_body_take(origin: str, folder: Path) -> KnownTake:
    """Version 1.21: 250 frames of one body, its markers and passing ones; no labels of the rows' kinds."""
    known = {
        "version": "1.21",
        "rate": 120.0,
        "frames": 250,
        "exported": 250,
        "seen": (250, 250),
    }
    if origin == RECORDED:
        return KnownTake(
            path=BESIDE / SINGLE_BODY,
            start=datetime(2016, 1, 5, 15, 49, 50, 755000, tzinfo=UTC),
            names=("Rigid Body 1",),
            first_position=(0.060002, 0.019150, 0.076611),
            **known,  # type: ignore[arg-type]
        )
    rng = np.random.default_rng(121)
    place = np.array([0.21, 0.034, -0.118])
    # The body's own markers, the same ones seen on their own, and reflections of which most cells are empty.
    shape = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.02], [0.0, 0.01, -0.06]])
    body = [("Rigid Body", "drill", "0FA3", kind) for kind in ["Rotation"] * 4 + ["Position"] * 3]
    body.append(("Rigid Body", "drill", "0FA3", "Error Per Marker"))
    for index in range(3):
        own = ("Rigid Body Marker", f"drill_{index + 1}", f"0FA3{index}")
        body += [(*own, "Position")] * 3 + [(*own, "Marker Quality")]
    passing = [("Marker", f"Unlabeled:{40 + i}", f"C{i}", "Position") for i in range(9) for _ in range(3)]
    columns = [*body, *passing]
    axes = ["X", "Y", "Z", "W", "X", "Y", "Z", "", *["X", "Y", "Z", ""] * 3, *["X", "Y", "Z"] * 9]
    lines = [
        "Format Version,1.21,Take Name,a drill at rest,Capture Frame Rate,120.000000,Export Frame Rate,"
        "120.000000,Capture Start Time,2017-03-02 09.05.01.250 AM,Total Frames in Take,250,Total Exported "
        "Frames,250,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global",
        "",
        *(",," + ",".join(column[row] for column in columns) for row in range(2)),
        ",," + ",".join(f'"{column[2]}"' for column in columns),
        ",," + ",".join(column[3] for column in columns),
        "Frame,Time," + ",".join(axes),
    ]
    for k in range(250):
        # Motive gives either sign of a quaternion; the first frame is written without noise, to be known.
        noise = 2e-5 * rng.standard_normal((2, 3)) * (k > 0)
        turn = -Rotation.from_rotvec(noise[0]).as_quat()
        centre = place + noise[1]
        values = [*turn, *centre, 8e-6 + 4e-6 * rng.random()]
        for marker in centre + shape:
            values += [*marker, 0.9 + 0.1 * rng.random()]
        cells = [f"{value:.6f}" for value in values]
        for index in range(9):
            seen = (k // 25 + index) % 3 == 0
            cells += [f"{v:.6f}" for v in rng.normal(1.0, 0.5, 3)] if seen else [""] * 3
        lines.append(f"{k},{k / 120:.6f}," + ",".join(cells))
    path = folder / "single_body.csv"
    path.write_text("\r\n".join(lines) + "\r\n")
    return KnownTake(
        path=path,
        start=datetime(2017, 3, 2, 9, 5, 1, 250000, tzinfo=UTC),
        names=("drill",),
        first_position=(0.21, 0.034, -0.118),
        **known,  # type: ignore[arg-type]
    )


def three_body_take(origin: str, folder: Path) -> KnownTake:
    """Version 1.23: a piece out of the middle of a long take, three bodies, frames lost, one body hidden."""
    if origin == RECORDED:
        return KnownTake(
            path=BESIDE / THREE_BODIES,
            version="1.23",
            start=datetime(2019, 9, 18, 16, 30, 2, 695000, tzinfo=UTC),
            names=("device02", "device03", "device05"),
            rate=100.0,
            frames=934,
            exported=190951,
            gaps=4,
            first_position=(0.142319, 0.160392, 2.000101),
            seen=(741, 759),
        )
    rng = np.random.default_rng(123)
    names, first, frames = ("scope", "tibia", "femur"), 61_440, 700
    lost = {*range(150, 153), 300, *range(420, 431), 610}
    numbers = [first + k for k in range(frames + len(lost)) if k not in lost]
    columns = [(name, f"A{name.upper()}") for name in names for _ in range(8)]
    kinds = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"]
    lines = [
        "Format Version,1.23,Take Name,cadaver 3,Take Notes,,Capture Frame Rate,100.000000,Export Frame Rate,"
        "100.000000,Capture Start Time,2020-02-29 11.58.00.005 PM,Total Frames in Take,99000,Total Exported "
        "Frames,99000,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global",
        "",
        ",Type," + ",".join(["Rigid Body"] * 24),
        ",Name," + ",".join(name for name, _ in columns),
        ",ID," + ",".join(f'"{number}"' for _, number in columns),
        ",," + ",".join(kinds * 3),
        "Frame,Time (Seconds)," + ",".join(["X", "Y", "Z", "W", "X", "Y", "Z", ""] * 3),
    ]
    hidden = 0
    for number in numbers:
        t = (number - first) / 100.0
        cells: list[str] = []
        for index in range(3):
            # The last body goes behind the surgeon once, and flickers.
            if index == 2 and (2.0 < t < 3.2 or number % 17 == 0):
                hidden += 1
                cells += [""] * 8
                continue
            swing = 0.02 * np.sin([0.9 * t + index, 1.3 * t, 0.7 * t + 2.0 * index])
            place = np.array([0.3 * index + 0.1, 0.9, 0.4]) + swing + 2e-5 * rng.standard_normal(3)
            turn = Rotation.from_rotvec([0.3 * index, 4.0 * swing[0], 5.0 * swing[1]]).as_quat()
            # Exported again by a script: digits that are zeros at the end are gone.
            values = [*turn, *place, 1e-4 + 5e-5 * rng.random()]
            cells += [f"{value:.6f}".rstrip("0") for value in values]
        lines.append(f"{number},{number / 100:g}," + ",".join(cells))
    path = folder / "three_bodies.csv"
    path.write_text("\n".join(lines) + "\n")
    written = [float(cell) for cell in lines[7].split(",")[6:9]]
    return KnownTake(
        path=path,
        version="1.23",
        start=datetime(2020, 2, 29, 23, 58, 0, 5000, tzinfo=UTC),
        names=names,
        rate=100.0,
        frames=frames,
        exported=99000,
        gaps=4,
        first_position=(written[0], written[1], written[2]),
        seen=(frames - hidden, frames - hidden),
    )


def take_without_body(origin: str, folder: Path) -> KnownTake:
    """Version 1.23 with Euler angles stated: markers without labels, most cells empty, no body."""
    if origin == RECORDED:
        start = datetime(2021, 4, 18, 14, 24, 27, 730000, tzinfo=UTC)
        return KnownTake(BESIDE / NO_BODY, "1.23", start, (), 100.0, 826, 826)
    rng = np.random.default_rng(826)
    names = [f"Unlabeled {2400 + index}" for index in range(5) for _ in range(3)]
    lines = [
        "Format Version,1.23,Take Name,a ball thrown,Take Notes,,Capture Frame Rate,100.000000,Export Frame "
        "Rate,100.000000,Capture Start Time,2022-07-01 08.00.00.000 AM,Total Frames in Take,200,Total "
        "Exported Frames,200,Rotation Type,XYZ,Length Units,Meters,Coordinate Space,Global",
        "",
        ",Type," + ",".join(["Marker"] * 15),
        ",Name," + ",".join(names),
        ",ID," + ",".join(f'"C{column // 3}"' for column in range(15)),
        ",," + ",".join(["Position"] * 15),
        "Frame,Time (Seconds)," + ",".join(["X", "Y", "Z"] * 5),
    ]
    for k in range(200):
        seen = [40 * index <= k < 40 * index + 3 for index in range(5)]
        cells = [f"{value:.6f}" if seen[i // 3] else "" for i, value in enumerate(rng.normal(1, 0.3, 15))]
        lines.append(f"{k},{k / 100:.6f}," + ",".join(cells))
    path = folder / "no_body.csv"
    path.write_text("\r\n".join(lines) + "\r\n")
    return KnownTake(path, "1.23", datetime(2022, 7, 1, 8, tzinfo=UTC), (), 100.0, 200, 200)
