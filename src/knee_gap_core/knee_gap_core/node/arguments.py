"""Command lines of every package: one line for a user's mistake, and numbers that are finite."""

import argparse
import math
import sys
from collections.abc import Sequence
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a mistake in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake and exit with 2."""
        self.exit(2, f"{self.prog}: {message}\n")

    def parse(self, argv: Sequence[str] | None = None) -> argparse.Namespace:
        """The arguments; options may stand between several positional ones (OUT --force TOPIC TOPIC)."""
        given = sys.argv[1:] if argv is None else argv
        if "--" in given:  # before a name that begins with a dash
            return self.parse_args(given)
        try:
            return self.parse_intermixed_args(given)
        except TypeError:  # not for a parser of subcommands
            return self.parse_args(given)


def positive(text: str) -> float:
    """Return a finite number above zero, for `type=` of an argument."""
    value = not_negative(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be greater than 0, is 0")
    return value


def finite(text: str) -> float:
    """Return a finite number, for `type=` of an argument."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, is {text}")
    return value


def not_negative(text: str) -> float:
    """Return a finite number of at least zero, for `type=` of an argument."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value) or value < 0:
        raise argparse.ArgumentTypeError(f"must be a finite number, 0 or more, is {text}")
    return value
