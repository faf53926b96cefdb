"""The frame of every command: one line for a user's mistake, and an orderly end by signal."""

import argparse
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from tqdm import tqdm

from knee_gap_core.node.arguments import Parser as Parser
from knee_gap_core.node.arguments import finite as finite
from knee_gap_core.node.arguments import not_negative as not_negative
from knee_gap_core.node.arguments import positive as positive
from knee_gap_core.values.errors import KneeGapError

Item = TypeVar("Item")
_SECONDS_BETWEEN_LINES = 10.0


def run(
    parser: Parser, command: Callable[[argparse.Namespace], int], argv: Sequence[str] | None = None
) -> int:
    """Parse, run the command, and return its exit code; 1 and one line for a mistake."""
    arguments = parser.parse(argv)
    # Ended from outside, a command still closes what it writes; those that end by themselves set their own.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    logging.basicConfig(level=logging.WARNING, format=f"{parser.prog}: %(message)s", stream=sys.stderr)
    try:
        return command(arguments)
    except (KneeGapError, OSError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{parser.prog}: stopped before the end", file=sys.stderr)
        return 130


def with_progress(
    messages: Iterable[Item], total: int | None, time_ns: Callable[[Item], int] | None = None
) -> Iterator[Item]:
    """Yield the messages: with a bar on a terminal, elsewhere with a line now and then.

    `time_ns` is the time of a message in the recording, from which the rate is taken.
    """
    pace = _Pace(total)
    if sys.stderr.isatty():
        with tqdm(messages, total=total, unit=" messages", leave=False) as bar:
            for message in bar:
                pace.note(None if time_ns is None else time_ns(message))
                if pace.is_due(1.0):
                    bar.set_postfix_str(pace.rate, refresh=False)
                yield message
        return
    for message in messages:
        if pace.is_due(_SECONDS_BETWEEN_LINES):
            print(pace.line, file=sys.stderr, flush=True)
        pace.note(None if time_ns is None else time_ns(message))
        yield message


class _Pace:
    """How far a command is, how fast, and how long it will still take."""

    def __init__(self, total: int | None) -> None:
        self._total = total
        self._count = self._recorded_ns = 0
        self._last_ns: int | None = None
        self._begun = self._told = time.monotonic()

    def note(self, time_ns: int | None) -> None:
        """Count a message; where the recorded time runs backwards it begins again."""
        self._count += 1
        if time_ns is not None:
            if self._last_ns is not None:
                self._recorded_ns += max(0, time_ns - self._last_ns)
            self._last_ns = time_ns

    def is_due(self, seconds: float) -> bool:
        """Whether so long a time has passed since it was last due."""
        now = time.monotonic()
        if now - self._told <= seconds:
            return False
        self._told = now
        return True

    @property
    def rate(self) -> str:
        """Recorded time by time passed; empty if it is not known."""
        passed = time.monotonic() - self._begun
        if not self._recorded_ns or passed <= 0.0:
            return ""
        return f"{self._recorded_ns * 1e-9 / passed:.2g} times real time"

    @property
    def line(self) -> str:
        """One line for those who read no bar."""
        words = [f"{self._count} messages"]
        if self._total:
            words[0] += f" ({100 * self._count // self._total} %)"
        words += [self.rate] if self.rate else []
        if self._total and self._count:
            left = (time.monotonic() - self._begun) * (self._total - self._count) / self._count
            words.append(f"{max(left, 0.0):.0f} s left")
        return ", ".join(words)


def stop_on_signals() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set, so that a command can end what it does in order."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
