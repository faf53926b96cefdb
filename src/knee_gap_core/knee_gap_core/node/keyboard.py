"""Keys pressed on a terminal, read one by one while a command runs."""

import contextlib
import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator

_ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right"}


@contextlib.contextmanager
def keys(press: Callable[[str], None]) -> Iterator[bool]:
    """Call `press` with each key while the context lasts; gives False where there is no terminal to read."""
    if not sys.stdin or not sys.stdin.isatty() or os.getpgrp() != os.tcgetpgrp(sys.stdin.fileno()):
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
                press(_ARROWS.get(pressed) or pressed[:1].decode(errors="replace"))

    reader = threading.Thread(target=read, name="keyboard", daemon=True)
    tty.setcbreak(descriptor)
    reader.start()
    try:
        yield True
    finally:
        ended.set()
        reader.join()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
