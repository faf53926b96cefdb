"""The bag that a command writes: what may be replaced by it."""

import argparse
from pathlib import Path

from knee_gap_core.bag.errors import BagError


def add_force_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument by which a bag that exists is replaced."""
    parser.add_argument("--force", action="store_true", help="replace OUT if it is a bag that exists already")


def refuse_input_as_output(bag: str, out: str) -> None:
    """Raise BagError if the bag to write is the one that is read, or lies around it."""
    source, target = Path(bag).resolve(), Path(out).resolve()
    if target == source or (target == source.parent and source.is_file()):
        raise BagError(f"{out} is the bag that is read; it exists already, choose another name")
