"""A study that was interrupted: the batches that are done, from which the same command goes on."""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from knee_gap_core.user_files import json_value, read_bytes
from knee_gap_uncertainty.studies.coverage.table import Row

MOST_BYTES = 256 << 20


class Unfinished:
    """Rows of finished batches in a file beside the results, which a change of runs or seed makes another."""

    def __init__(self, out: Path, runs: int, seed: int) -> None:
        self.path = out / f"unfinished_{runs}_runs_seed_{seed}.jsonl"

    def read(self) -> dict[int, list[Row]]:
        """Rows by the number of the batch, none where nothing was begun; a line cut off does not count.

        Raises FileError where something else than a file stands in its place.
        """
        found: dict[int, list[Row]] = {}
        if not os.path.lexists(self.path):
            return found
        for line in read_bytes(self.path, MOST_BYTES).decode(errors="replace").splitlines():
            try:
                number, rows = json_value(line)
                found[int(number)] = [Row(**row) for row in rows]
            except (ValueError, TypeError):
                continue
        return found

    def add(self, number: int, rows: Sequence[Row]) -> None:
        """Append a finished batch."""
        with self.path.open("a") as file:
            file.write(json.dumps([number, [asdict(row) for row in rows]]) + "\n")

    def remove(self) -> None:
        """Forget it: all is done."""
        self.path.unlink(missing_ok=True)
