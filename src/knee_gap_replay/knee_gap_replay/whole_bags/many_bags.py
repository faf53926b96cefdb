"""Many bags processed at once: resumable, and a bag that fails does not stop the others."""

import csv
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from knee_gap_core.bag.errors import BagError
from knee_gap_core.user_files import FileError, json_value, read_bytes, reason_of
from knee_gap_replay.whole_bags.one_bag import Job
from knee_gap_replay.whole_bags.pools import Ended, Pool

_STATE, _SUMMARY = "process.json", "summary.csv"
_MOST_STATE_BYTES = 64 << 20
_COLUMNS = ("bag", "result", "images", "estimates", "valid", "damaged parts", "seconds", "remark")


class JobMaker(Protocol):
    """Makes the job of one bag."""

    def __call__(self, bag: str, out: str, *, replace: bool) -> Job:
        """Return the job."""


class _Row(NamedTuple):
    """One bag in the summary, and in the state by which a run that was stopped goes on."""

    bag: str
    name: str
    result: str  # done, failed, begun
    images: int = 0
    estimates: int = 0
    valid: int = 0
    losses: int = 0
    seconds: float = 0.0
    remark: str = ""
    is_ours: bool = True  # what lies at its place was written by such a run, and may be replaced


def process_many(
    bags: Sequence[str], folder: Path, make_job: JobMaker, pool: Pool, *, force: bool = False
) -> int:
    """Process bags into `folder`, one bag of results each, and print a table; return 1 if any failed.

    Bags that an earlier run has done are left out, unless `force`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BagError(f"{folder} cannot be made: {reason_of(error)}") from None
    state = _State(folder, _names(bags), {} if force else _read_state(folder / _STATE))
    waiting = state.waiting()
    if skipped := len(state.names) - len(waiting):
        print(f"process: {skipped} bags are done already", flush=True)
    running: set[str] = set()
    try:
        while waiting or running:
            while waiting and len(running) < pool.size:
                bag = waiting.pop(0)
                out = folder / state.names[bag]
                replace = force or state.is_ours(bag)
                if os.path.lexists(out) and not replace:
                    state.end(Ended(bag, "failed", f"{out} exists already", {}), is_ours=False)
                    continue
                state.begin(bag)
                running.add(bag)
                pool.start(bag, make_job(bag, str(out), replace=replace))
            for ended in pool.ended() if running else ():
                running.discard(ended.bag)
                state.end(ended)
    finally:
        for ended in pool.close():
            state.end(ended)
    return state.finish()


class _State:
    """The row of each bag, kept in a file so that a run that was stopped goes on."""

    def __init__(self, folder: Path, names: dict[str, str], rows: dict[str, _Row]) -> None:
        self.names = names
        self._folder, self._rows = folder, rows
        self._begun: dict[str, float] = {}

    def waiting(self) -> list[str]:
        """Return the bags that are not done."""
        return [bag for bag in self.names if bag not in self._rows or self._rows[bag].result != "done"]

    def is_ours(self, bag: str) -> bool:
        """Whether an earlier run began this bag, so that what it left may be replaced."""
        return bag in self._rows and self._rows[bag].is_ours

    def begin(self, bag: str) -> None:
        """Note that a bag is begun."""
        self._begun[bag] = time.monotonic()
        self._write(_Row(bag, self.names[bag], "begun"))

    def end(self, ended: Ended, *, is_ours: bool = True) -> None:
        """Note how a bag ended, and print it."""
        bag, counts = ended.bag, ended.counts

        def count(name: str) -> int:
            return sum(n for topic, n in counts.items() if topic.endswith(f"/{name}"))

        seconds = time.monotonic() - self._begun.get(bag, time.monotonic())
        row = _Row(
            bag, self.names[bag], ended.result, count("gap_edges"), count("gap"), count("gap/snr"),
            ended.losses, round(seconds, 2), ended.remark, is_ours,
        )  # fmt: skip
        self._write(row)
        rows = [self._rows[name] for name in self.names if name in self._rows]
        done = sum(one.result in ("done", "failed") for one in rows)
        remark = f": {row.remark}" if row.remark else ""
        print(f"process: {done} of {len(self.names)}: {bag} {row.result}{remark}", flush=True)

    def finish(self) -> int:
        """Write and print the table; return 1 if a bag failed."""
        ordered = [self._rows[bag] for bag in self.names]
        _write_summary(self._folder / _SUMMARY, ordered)
        print(_table(ordered), flush=True)
        failed = sum(row.result != "done" for row in ordered)
        words = f"{len(ordered) - failed} bags done, {failed} failed; results in {self._folder}"
        print(f"process: {words}", flush=True)
        return 1 if failed else 0

    def _write(self, row: _Row) -> None:
        self._rows[row.bag] = row
        _write_state(self._folder / _STATE, self._rows)


def _names(bags: Sequence[str]) -> dict[str, str]:
    """Return a name of its own for the results of each bag."""
    names: dict[str, str] = {}
    for bag in dict.fromkeys(bags):
        path = Path(os.path.abspath(bag))
        name = stem = path.name.removesuffix(".mcap")
        number = 2
        while name in names.values():
            name, number = f"{stem}_{number}", number + 1
        names[bag] = name
    return names


def _read_state(path: Path) -> dict[str, _Row]:
    if not path.exists():
        return {}
    try:
        held = json_value(read_bytes(path, _MOST_STATE_BYTES).decode())
        rows = [_Row(**row) for row in held["bags"]]
    except (FileError, ValueError, TypeError, LookupError, AttributeError):
        raise BagError(f"{path} is damaged: remove it, or use --force to process all bags again") from None
    return {row.bag: row for row in rows}


def _write_state(path: Path, rows: dict[str, _Row]) -> None:
    _replace(path, lambda draft: draft.write_text(json.dumps({"bags": [r._asdict() for r in rows.values()]})))


def _write_summary(path: Path, rows: Sequence[_Row]) -> None:
    def write(draft: Path) -> None:
        with draft.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(_COLUMNS)
            writer.writerows(_cells(row) for row in rows)

    _replace(path, write)


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    draft = path.with_name(f"{path.name}.tmp")
    write(draft)
    draft.replace(path)


def _cells(row: _Row) -> tuple[str, ...]:
    numbers = (row.images, row.estimates, row.valid, row.losses)
    return (row.bag, row.result, *(str(number) for number in numbers), f"{row.seconds:.1f}", row.remark)


def _table(rows: Sequence[_Row]) -> str:
    lines = [_COLUMNS, *(_cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(_COLUMNS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
