"""Tables of the study as CSV, and for the terminal."""

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

Table: TypeAlias = tuple[Sequence[str], Sequence[Sequence[object]]]


def write_csv(path: Path, columns: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    """One table, numbers to six digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for line in lines:
            writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in line])


def plain(columns: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A table in columns of equal width."""
    texts = [[shown(value, 4) for value in line] for line in (columns, *lines)]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in texts
    )


def shown(value: object, digits: int = 3) -> str:
    """A value for a person: unknown is a dash, unbounded an infinity sign."""
    if not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"
