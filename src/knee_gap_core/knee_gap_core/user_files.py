"""Files that a user names, opened with bounds on their kind, size and depth.

A file may be anything: a FIFO that would be waited for without end, a device that has no end, YAML that is
nested until the interpreter gives up or that refers to itself. Every reader of this suite opens its files
here; what cannot be used raises FileError, one line that names the file and the rule.
"""

import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent

from knee_gap_core.values.errors import KneeGapError

# Parameters, calibrations and a bag's metadata are thousands of bytes; some seconds of reading at most.
MOST_YAML_BYTES = 1 << 19
MOST_YAML_DEPTH = 32
# Values of all kinds: those of a scope's calibration are 200, of a bag's metadata 20 a topic.
MOST_YAML_VALUES = 10_000
MOST_JSON_DEPTH = 32

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class FileError(KneeGapError):
    """A file that cannot be used; the message is one line and names the file and the reason."""


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading, never waiting for another process.

    Raises FileError if there is none, or it may not be read.
    """
    try:
        # A FIFO without a writer would block a plain open.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise FileError(f"{shown(path)}: {reason_of(error)}") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise FileError(f"{shown(path)} is {_kind(mode)}, not a file")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Return all bytes of a regular file. Raises FileError for one that is longer than `most_bytes`."""
    with open_file(path) as file:
        try:
            data = file.read(most_bytes + 1)
        except OSError as error:
            raise FileError(f"{shown(path)}: {reason_of(error)}") from None
    if len(data) > most_bytes:
        raise FileError(f"{shown(path)} is longer than {_size(most_bytes)}")
    return data


def read_yaml(path: Path) -> Any:
    """Return what a YAML file holds.

    Raises FileError for a file that is no YAML, is longer or deeper than any of this suite, or uses aliases,
    by which a small file can stand for an endless one (ROS does not read them either).
    """
    text = read_bytes(path, MOST_YAML_BYTES)
    try:
        return yaml_value(text.decode())
    except ValueError as error:
        reason = "it is not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
        raise FileError(f"{shown(path)} is not a YAML file that can be read: {reason}") from None


def yaml_value(text: str) -> Any:
    """Return the value of a YAML text. Raises ValueError, one line, as `read_yaml` does."""
    if len(text) > MOST_YAML_BYTES:
        raise ValueError(f"it is longer than {_size(MOST_YAML_BYTES)}")
    try:
        _check_events(text)
        return YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        raise ValueError(f"{_one_line(error.problem or 'damaged')}{line}") from None
    except (YAMLError, ValueError, TypeError, OverflowError, AttributeError, LookupError) as error:
        # An impossible date, a number too large, a key of a wrong kind.
        raise ValueError(_one_line(str(error)) or "damaged") from None


def json_value(text: str) -> Any:
    """Return the value of a JSON text. Raises ValueError, one line, for another text or deep nesting."""
    depth = deepest = 0
    for letter in text:
        if letter in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif letter in "]}":
            depth -= 1
    if deepest > MOST_JSON_DEPTH:
        # Brackets in strings count as well: none of this suite's has as many.
        raise ValueError(f"nested more than {MOST_JSON_DEPTH} deep")
    return json.loads(text)


def expanded(text: str) -> Path:
    """Return the path that a user wrote, `~` replaced. Raises FileError for a user that is unknown."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise FileError(f"{_one_line(text)}: there is no such user") from None


def flaw_of_new(path: Path) -> str:
    """Why nothing new can be written at `path`; empty where it can. A dangling link counts as existing."""
    if os.path.islink(path) and not path.exists():
        return f"{shown(path)} is a link that leads nowhere; choose another name or remove it"
    if os.path.lexists(path):
        return f"{shown(path)} exists already; choose another name or remove it"
    return ""


def reason_of(error: Exception) -> str:
    """Return the words of an operating system's error, without number and path."""
    strerror = getattr(error, "strerror", None)
    return str(strerror or _one_line(str(error)) or type(error).__name__)


def shown(path: Path) -> str:
    """Return a path as one line, whatever is in its name."""
    return _one_line(str(path))


def _check_events(text: str) -> None:
    """Raise ValueError where the events of a YAML text are too many or too deep: they take no recursion."""
    depth = count = 0
    for event in YAML(typ="safe", pure=True).parse(text):
        if isinstance(event, AliasEvent):
            raise ValueError(f"aliases are not read (*{event.anchor} in line {event.start_mark.line + 1})")
        if isinstance(event, CollectionStartEvent):
            depth += 1
        elif isinstance(event, CollectionEndEvent):
            depth -= 1
        count += isinstance(event, ScalarEvent | CollectionStartEvent)
        if depth > MOST_YAML_DEPTH:
            raise ValueError(f"nested more than {MOST_YAML_DEPTH} deep in line {event.start_mark.line + 1}")
        if count > MOST_YAML_VALUES:
            raise ValueError(f"more than {MOST_YAML_VALUES} values")


def _kind(mode: int) -> str:
    return next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")


def _one_line(text: str) -> str:
    printable = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(printable.split())[:300]


def _size(count: int) -> str:
    return f"{count >> 20} MiB" if count >= 1 << 20 else f"{count >> 10} KiB"
