"""Keys pressed on a terminal, read one by one while a command runs."""

import contextlib
import os
import re
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator

_ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right"}


_KEY = re.compile(rb"\x1b\[[A-D]|[^\x1b]", re.DOTALL)


@contextlib.contextmanager
def keys(press: Callable[[str], None]) -> Iterator[bool]:
    """Call `press` with each key while the context lasts; gives False where there is no terminal to read."""
    if not _is_ours():
        yield False
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    ended = threading.Event()

    def read() -> None:
        while not ended.is_set():
            if select.select([descriptor], [], [], 0.1)[0]:
                pressed = os.read(descriptor, 16)
                if not pressed:
                    return
                for key in _KEY.findall(pressed):
                    press(_ARROWS.get(key) or key.decode(errors="replace"))

    reader = threading.Thread(target=read, name="keyboard", daemon=True)
    tty.setcbreak(descriptor)
    reader.start()
    try:
        yield True
    finally:
        ended.set()
        reader.join()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _is_ours() -> bool:
    """Whether the standard input is a terminal, and this process in its foreground."""
    try:
        return sys.stdin.isatty() and os.getpgrp() == os.tcgetpgrp(sys.stdin.fileno())
    except (AttributeError, OSError, ValueError):  # closed, or not the terminal of this session
        return False
