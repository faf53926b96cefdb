"""What the commands of this package share: one line for a user's mistake, and an orderly end by signal."""

import argparse
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from tqdm import tqdm

from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.arguments import Parser as Parser
from knee_gap_core.node.arguments import finite as finite
from knee_gap_core.node.arguments import not_negative as not_negative
from knee_gap_core.node.arguments import positive as positive
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.user_files import FileError

Item = TypeVar("Item")
_SECONDS_BETWEEN_LINES = 10.0


def run(
    parser: Parser, command: Callable[[argparse.Namespace], int], argv: Sequence[str] | None = None
) -> int:
    """Parse, run the command, and return its exit code; 1 and one line for a mistake."""
    arguments = parser.parse_args(argv)
    # Ended from outside, a command still closes what it writes; those that end by themselves set their own.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    logging.basicConfig(level=logging.WARNING, format=f"{parser.prog}: %(message)s", stream=sys.stderr)
    try:
        return command(arguments)
    except (BagError, ConfigurationError, FileError, OSError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{parser.prog}: stopped before the end", file=sys.stderr)
        return 130


def with_progress(messages: Iterable[Item], total: int | None) -> Iterator[Item]:
    """Yield the messages: with a bar on a terminal, elsewhere with a line now and then."""
    if sys.stderr.isatty():
        yield from tqdm(messages, total=total, unit=" messages", leave=False)
        return
    printed = time.monotonic()
    for count, message in enumerate(messages):
        if time.monotonic() - printed > _SECONDS_BETWEEN_LINES:
            printed = time.monotonic()
            share = f" ({100 * count // total} %)" if total else ""
            print(f"{count} messages{share}", file=sys.stderr, flush=True)
        yield message


def stop_on_signals() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set, so that a command can end what it does in order."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
