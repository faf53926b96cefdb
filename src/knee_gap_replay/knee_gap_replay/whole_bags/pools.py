"""Where bags are processed: in processes of this machine. `cluster_pool` has the same for a cluster."""

import contextlib
import io
import multiprocessing
from collections.abc import Iterable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol

from knee_gap_core.values.errors import KneeGapError
from knee_gap_replay.whole_bags.one_bag import Job, process_one
from knee_gap_replay.whole_bags.overlapped import usable_cores

_FORK = multiprocessing.get_context("fork")


class Ended(NamedTuple):
    """How a bag ended: `result` is done or failed, `counts` the number of results by topic."""

    bag: str
    result: str
    remark: str
    counts: dict[str, int]
    losses: int = 0


class Pool(Protocol):
    """Processes bags, several at once."""

    @property
    def size(self) -> int:
        """Number of bags at once."""

    def start(self, bag: str, job: Job) -> None:
        """Begin to process a bag."""

    def ended(self) -> Sequence[Ended]:
        """Return those that have ended, after waiting for at least one or for a moment."""

    def close(self) -> Iterable[Ended]:
        """End what still runs, or wait for its end and return how it ended."""


def outcome(bag: str, job: Job) -> Ended:
    """Process one bag; never raises for a bag that cannot be processed."""
    try:
        result = process_one(job, workers=1)
    except (KneeGapError, OSError) as error:
        return Ended(bag, "failed", str(error), {})
    remark = result.lines[-1] if result.exit_code else "; ".join(result.lines[:-1])
    return Ended(bag, "failed" if result.exit_code else "done", remark, result.counts, result.losses)


class _Running(NamedTuple):
    bag: str
    process: Any
    connection: Connection


class ProcessPool:
    """A process for each bag, so many at once as there are cores. A `Pool`."""

    def __init__(self, workers: int | None = None) -> None:
        self.size = workers or usable_cores()
        self._running: list[_Running] = []

    def start(self, bag: str, job: Job) -> None:
        """Process a bag in a process of its own."""
        ours, theirs = _FORK.Pipe(duplex=False)
        process = _FORK.Process(target=_work, args=(bag, job, theirs), daemon=True)
        process.start()
        theirs.close()
        self._running.append(_Running(bag, process, ours))

    def ended(self) -> Sequence[Ended]:
        """Return those that have ended, after waiting for at least one."""
        ready = wait([one.connection for one in self._running])
        ended = [one for one in self._running if one.connection in ready]
        self._running = [one for one in self._running if one not in ended]
        return [_ended(one) for one in ended]

    def close(self) -> Iterable[Ended]:
        """End the processes that still run; their bags stay begun."""
        for left in self._running:
            left.process.terminate()
            left.process.join()
        return ()


def _work(bag: str, job: Job, connection: Connection) -> None:
    """Process one bag in a process of its own, and send how it went."""
    # No parent process any more, or an interrupt: the state then records that the bag was begun. Bars of
    # several bags would overwrite each other.
    with (
        contextlib.suppress(BrokenPipeError, KeyboardInterrupt),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        connection.send(outcome(bag, job))


def _ended(running: _Running) -> Ended:
    try:
        ended = running.connection.recv()
    except EOFError:
        running.process.join()
        return Ended(running.bag, "failed", f"its process ended with {running.process.exitcode}", {})
    running.process.join()
    running.connection.close()
    assert isinstance(ended, Ended)
    return ended
