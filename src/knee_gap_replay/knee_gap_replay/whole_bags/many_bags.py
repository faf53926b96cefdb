"""Many bags processed by several processes: resumable, and a bag that fails does not stop the others."""

import contextlib
import csv
import io
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from knee_gap_core.bag.errors import BagError
from knee_gap_core.user_files import FileError, json_value, read_bytes, reason_of
from knee_gap_core.values.errors import KneeGapError
from knee_gap_replay.whole_bags.one_bag import Job, process_one
from knee_gap_replay.whole_bags.overlapped import usable_cores

_FORK = multiprocessing.get_context("fork")
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


class _Running(NamedTuple):
    process: Any
    connection: Connection
    row: _Row
    begun: float


def process_many(
    bags: Sequence[str], folder: Path, make_job: JobMaker, workers: int | None = None, *, force: bool = False
) -> int:
    """Process bags into `folder`, one bag of results each, and print a table; return 1 if any failed.

    Bags that an earlier run has done are left out, unless `force`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BagError(f"{folder} cannot be made: {reason_of(error)}") from None
    rows = {} if force else _read_state(folder / _STATE)
    names = _names(bags)
    waiting = [bag for bag in names if rows.get(bag, _Row("", "", "")).result != "done"]
    if skipped := len(names) - len(waiting):
        print(f"process: {skipped} bags are done already", flush=True)
    running: list[_Running] = []
    try:
        while waiting or running:
            while waiting and len(running) < (workers or usable_cores()):
                bag = waiting.pop(0)
                replace = force or bag in rows
                rows[bag] = _Row(bag, names[bag], "begun")
                _write_state(folder / _STATE, rows)
                running.append(_start(make_job(bag, str(folder / names[bag]), replace=replace), rows[bag]))
            for ended in _ended(running):
                running.remove(ended)
                row = _row_of(ended)
                rows[row.bag] = row
                _write_state(folder / _STATE, rows)
                done = sum(rows[bag].result in ("done", "failed") for bag in names if bag in rows)
                remark = f": {row.remark}" if row.remark else ""
                print(f"process: {done} of {len(names)}: {row.bag} {row.result}{remark}", flush=True)
    finally:
        for left in running:
            left.process.terminate()
            left.process.join()
    ordered = [rows[bag] for bag in names]
    _write_summary(folder / _SUMMARY, ordered)
    print(_table(ordered), flush=True)
    failed = sum(row.result != "done" for row in ordered)
    print(f"process: {len(ordered) - failed} bags done, {failed} failed; results in {folder}", flush=True)
    return 1 if failed else 0


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


def _start(job: Job, row: _Row) -> _Running:
    ours, theirs = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_work, args=(job, theirs), daemon=True)
    process.start()
    theirs.close()
    return _Running(process, ours, row, time.monotonic())


def _work(job: Job, connection: Connection) -> None:
    """Process one bag in a process of its own, and send how it went."""
    # Nobody to tell any more, or an end from outside: the state then says that the bag was begun.
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        connection.send(_outcome(job))


def _outcome(job: Job) -> tuple[str, str, dict[str, int], int, int]:
    # Bars of several bags would overwrite each other.
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            result = process_one(job, workers=1)
        except (KneeGapError, OSError) as error:
            return ("failed", str(error), {}, 0, 0)
    remark = result.lines[-1] if result.exit_code else "; ".join(result.lines[:-1])
    valid = sum(count for topic, count in result.counts.items() if topic.endswith("/gap/snr"))
    return ("failed" if result.exit_code else "done", remark, result.counts, result.losses, valid)


def _ended(running: Sequence[_Running]) -> list[_Running]:
    """Return those that have ended, after waiting for at least one."""
    ready = wait([one.connection for one in running])
    return [one for one in running if one.connection in ready]


def _row_of(ended: _Running) -> _Row:
    seconds = time.monotonic() - ended.begun
    try:
        result, remark, counts, losses, valid = ended.connection.recv()
    except EOFError:
        ended.process.join()
        remark = f"its process ended with {ended.process.exitcode}"
        return ended.row._replace(result="failed", remark=remark, seconds=seconds)
    ended.process.join()
    ended.connection.close()

    def count(name: str) -> int:
        return sum(n for topic, n in counts.items() if topic.endswith(f"/{name}"))

    return ended.row._replace(
        result=result,
        remark=remark,
        images=count("gap_edges"),
        estimates=count("gap"),
        valid=valid,
        losses=losses,
        seconds=round(seconds, 2),
    )


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
