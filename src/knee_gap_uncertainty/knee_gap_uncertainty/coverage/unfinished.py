"""A study that was interrupted: the batches that are done, from which the same command goes on."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from knee_gap_uncertainty.coverage.table import Row


class Unfinished:
    """Rows of finished batches in a file beside the results, which a change of runs or seed makes another."""

    def __init__(self, out: Path, runs: int, seed: int) -> None:
        self.path = out / f"unfinished_{runs}_runs_seed_{seed}.jsonl"

    def read(self) -> dict[int, list[Row]]:
        """Rows by the number of the batch, none where nothing was begun; a line cut off does not count."""
        found: dict[int, list[Row]] = {}
        if not self.path.exists():
            return found
        for line in self.path.read_text().splitlines():
            try:
                number, rows = json.loads(line)
            except ValueError:
                continue
            found[number] = [Row(**row) for row in rows]
        return found

    def add(self, number: int, rows: Sequence[Row]) -> None:
        """Append a finished batch."""
        with self.path.open("a") as file:
            file.write(json.dumps([number, [asdict(row) for row in rows]]) + "\n")

    def remove(self) -> None:
        """Forget it: all is done."""
        self.path.unlink(missing_ok=True)
