"""The numbers of a report as tables: CSV, and Parquet if pyarrow is installed."""

import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from knee_gap_core.node.errors import ConfigurationError
from knee_gap_replay.report.page import Content
from knee_gap_replay.report.results import status_name

Column = list[Any]


def columns(content: Content) -> dict[str, Column]:
    """Columns with an entry for each estimate: the fields of knee_gap_msgs/GapEstimate, time and truth.

    Unknown numbers are None.
    """
    results = content.results
    numbers = {"time": results.time, **results.numbers, "gap_true": content.truth}
    known = {
        name: [None if np.isnan(value) else float(value) for value in column]
        for name, column in numbers.items()
    }
    return {
        "stamp_ns": results.stamps_ns.tolist(),
        "time": known.pop("time"),
        "status": [status_name(status) for status in results.status.tolist()],
        "reason": list(results.reasons),
        "track_id": results.track_ids.tolist(),
        **known,
    }


def write_csv(content: Content, path: Path) -> None:
    """Write a line for each estimate; numbers with all their digits, unknown ones empty."""
    table = columns(content)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*table.values(), strict=True))


def write_parquet(content: Content, path: Path) -> None:
    """Write the same table as Parquet; unknown numbers are null. Raises ConfigurationError."""
    arrow, parquet = _arrow()
    kinds = {
        "stamp_ns": arrow.int64(),
        "track_id": arrow.int64(),
        "status": arrow.string(),
        "reason": arrow.string(),
    }
    table = columns(content)
    arrays = [arrow.array(column, kinds.get(name, arrow.float64())) for name, column in table.items()]
    parquet.write_table(arrow.Table.from_arrays(arrays, names=list(table)), path)


def require_parquet() -> None:
    """Raise ConfigurationError if Parquet cannot be written."""
    _arrow()


def _arrow() -> tuple[Any, Any]:
    """The library and its Parquet module, which are not installed by the set-up."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        raise ConfigurationError(
            "--parquet needs pyarrow: "
            "tools/env uv pip install --require-hashes -r tools/requirements/parquet.lock"
        ) from None
