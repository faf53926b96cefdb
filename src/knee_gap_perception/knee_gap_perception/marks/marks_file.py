"""The file of marks: JSON, one for a folder of pictures, with polygons and hashes and no pixels.

Each rule that is broken is one line that names the file, the picture and the rule.
"""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knee_gap_core.user_files import FileError, json_value, read_bytes, shown
from knee_gap_core.values.arrays import Array
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.marks.marked_picture import Box, Decision, MarkedField, MarkedPicture, Region

FORMAT = "knee_gap_marks 1"
MOST_BYTES = 32 << 20
LARGEST_SIDE = 16384  # [px]
BEYOND = 2.0  # [px] by which a polygon may leave the picture
_TEXTS = ("file", "sha256", "source", "kind", "decision")
_KEYS = {*_TEXTS, "frame", "width", "height", "field", "notch_deg", "note", *Region}


def read_marks(path: Path) -> list[MarkedPicture]:
    """Marks of a file. Raises PerceptionError for one that breaks a rule."""
    try:
        value = json_value(read_bytes(path, MOST_BYTES).decode())
    except FileError as error:
        raise PerceptionError(str(error)) from None
    except ValueError as error:
        raise PerceptionError(f"{shown(path)} is not a JSON file that can be read: {error}") from None
    try:
        return marks_of(value)
    except PerceptionError as error:
        raise PerceptionError(f"{shown(path)}: {error}") from None


def marks_of(value: Any) -> list[MarkedPicture]:
    """Marks of a JSON value. Raises PerceptionError."""
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise PerceptionError(f'not a file of marks: "format" must be "{FORMAT}"')
    entries = value.get("pictures")
    if not isinstance(entries, list):
        raise PerceptionError('"pictures" must be a list')
    pictures: list[MarkedPicture] = []
    for index, entry in enumerate(entries):
        try:
            pictures.append(_picture(entry))
        except PerceptionError as error:
            name = entry.get("file") if isinstance(entry, dict) else None
            named = f" ({name})" if isinstance(name, str) and name.isprintable() else ""
            raise PerceptionError(f"picture {index}{named}: {error}") from None
    names = [picture.name for picture in pictures]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise PerceptionError(f"{twice[0]} is marked twice")
    return pictures


def write_marks(path: Path, pictures: Sequence[MarkedPicture]) -> None:
    """Write marks so that the file is whole at any moment. Raises OSError if it cannot be written."""
    entries = ",\n".join(_entry_text(value_of(picture)) for picture in pictures)
    text = f'{{\n"format": "{FORMAT}",\n"pictures": [\n{entries}\n]\n}}\n'
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text, encoding="utf-8")
    os.replace(unfinished, path)


def value_of(picture: MarkedPicture) -> dict[str, Any]:
    """The JSON value of a picture's marks; what is not marked is left out."""
    value: dict[str, Any] = {name: str(getattr(picture, name)) for name in _TEXTS}
    value |= {"width": picture.width, "height": picture.height}
    if picture.frame is not None:
        value["frame"] = picture.frame
    if picture.field is not None:
        value["field"] = _field_value(picture.field)
    if picture.notch is not None:
        value["notch_deg"] = round(math.degrees(picture.notch), 1)
    for region in Region:
        if polygons := picture.polygons(region):
            value[region] = [_short(polygon) for polygon in polygons]
    if picture.note:
        value["note"] = picture.note
    return value


def _field_value(field: MarkedField) -> dict[str, Any]:
    value: dict[str, Any] = {}
    if field.disc is not None:
        value["disc"] = _short(np.array(field.disc))
    if field.polygon is not None:
        value["polygon"] = _short(field.polygon)
    if field.box is not None:
        value["box"] = _short(np.array(field.box))
    return value


def _short(numbers: Array) -> Any:
    """Tenths of a pixel, without a point where it is whole."""
    if numbers.ndim > 1:
        return [_short(row) for row in numbers]
    return [int(number) if number == int(number) else float(number) for number in np.round(numbers, 1)]


def _entry_text(value: Mapping[str, Any]) -> str:
    """One key a line: a change of one polygon is one line."""
    lines = ",\n  ".join(f"{json.dumps(key)}: {json.dumps(part)}" for key, part in value.items())
    return f"{{ {lines} }}"


def _picture(entry: Any) -> MarkedPicture:
    if not isinstance(entry, dict):
        raise PerceptionError("must be an object")
    if unknown := sorted(entry.keys() - _KEYS):
        raise PerceptionError(f'"{unknown[0]}" is not known; known are {", ".join(sorted(_KEYS))}')
    texts = {key: _text(entry, key) for key in _TEXTS}
    if "/" in texts["file"] or texts["file"].startswith("."):
        raise PerceptionError('"file" must be a name without a folder')
    if not re.fullmatch(r"[0-9a-f]{64}", texts["sha256"]):
        raise PerceptionError('"sha256" must be 64 digits 0-9, a-f')
    if texts["decision"] not in list(Decision):
        raise PerceptionError(f'"decision" must be one of {", ".join(Decision)}, not {texts["decision"]}')
    width, height = (_whole(entry, key, 1, LARGEST_SIDE) for key in ("width", "height"))
    regions = {}
    for region in Region:
        if polygons := _polygons(entry.get(region, []), region, (width, height)):
            regions[region] = polygons
    decision = Decision(texts["decision"])
    if (decision is Decision.GAP) != (Region.GAP in regions) and decision is not Decision.UNCLEAR:
        has = "no polygon of a gap" if decision is Decision.GAP else "polygons of a gap"
        raise PerceptionError(f'the decision is "{decision}", but there are {has}')
    notch = entry.get("notch_deg")
    if notch is not None:
        notch = math.radians(_number(notch, '"notch_deg"'))
    return MarkedPicture(
        texts["file"],
        texts["sha256"],
        width,
        height,
        texts["source"],
        texts["kind"],
        decision,
        None if entry.get("frame") is None else _whole(entry, "frame", 0, 1 << 31),
        None if entry.get("field") is None else _field(entry["field"]),
        notch,
        regions,
        _text(entry, "note") if entry.get("note") else "",
    )


def _text(entry: Mapping[str, Any], key: str) -> str:
    value = entry.get(key)
    if not isinstance(value, str) or not value or not value.isprintable() or len(value) > 300:
        raise PerceptionError(f'"{key}" must be a line of text')
    return value


def _whole(entry: Mapping[str, Any], key: str, least: int, most: int) -> int:
    value = entry.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise PerceptionError(f'"{key}" must be a whole number from {least} to {most}')
    return value


def _number(value: Any, what: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise PerceptionError(f"{what} must be a finite number")
    return float(value)


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise PerceptionError(f"{what} must be {count} numbers")
    return tuple(_number(one, what) for one in value)


def _polygon(value: Any, what: str) -> Array:
    if not isinstance(value, list) or len(value) < 3:
        count = len(value) if isinstance(value, list) else 0
        raise PerceptionError(f"{what} has {count} points, a polygon has at least 3")
    return np.array([_numbers(point, 2, f"each point of {what}") for point in value])


def _polygons(value: Any, region: Region, size: tuple[int, int]) -> tuple[Array, ...]:
    if not isinstance(value, list):
        raise PerceptionError(f'"{region}" must be a list of polygons')
    polygons = tuple(_polygon(one, f'polygon {index} of "{region}"') for index, one in enumerate(value))
    for index, polygon in enumerate(polygons):
        outside = (polygon < -BEYOND) | (polygon > np.array(size) + BEYOND)
        if outside.any():
            x, y = polygon[outside.any(axis=1)][0]
            raise PerceptionError(
                f'polygon {index} of "{region}" leaves the picture of {size[0]}x{size[1]} px at {x:g}, {y:g}'
            )
    return polygons


def _field(value: Any) -> MarkedField:
    if not isinstance(value, dict) or not value or value.keys() - {"disc", "polygon", "box"}:
        raise PerceptionError('"field" must have a disc, a polygon or a box, or a box beside one of them')
    if "disc" in value and "polygon" in value:
        raise PerceptionError('"field" must have a disc or a polygon, not both')
    disc = polygon = box = None
    if "disc" in value:
        x, y, radius = _numbers(value["disc"], 3, "the field's disc")
        if radius <= 0:
            raise PerceptionError("the field's disc must have a radius above 0")
        disc = (x, y, radius)
    if "polygon" in value:
        polygon = _polygon(value["polygon"], "the field's polygon")
    if "box" in value:
        box = _box(value["box"])
    return MarkedField(disc, polygon, box)


def _box(value: Any) -> Box:
    x0, y0, x1, y1 = _numbers(value, 4, "the field's box")
    if not (x0 < x1 and y0 < y1):
        raise PerceptionError("the field's box must be first column, first row, last column, last row")
    return x0, y0, x1, y1
