"""Keys arrive one by one from a terminal, and a terminal is left as it was."""

import os
import pty
import subprocess
import sys
import time
from collections.abc import Callable

PROGRAM = """
import sys, termios, time
from knee_gap_core.node.keyboard import keys
pressed = []
before = termios.tcgetattr(0)
with keys(pressed.append) as heard:
    print("ready", flush=True)
    end = time.monotonic() + 20
    while len(pressed) < 5 and time.monotonic() < end:
        time.sleep(0.01)
print(heard, pressed, termios.tcgetattr(0) == before, flush=True)
"""


def read_until(descriptor: int, done: Callable[[str], bool]) -> str:
    text, end = "", time.monotonic() + 30.0
    while not done(text) and time.monotonic() < end:
        text += os.read(descriptor, 1000).decode()
    return text


def test_keys_of_a_terminal_are_taken_singly() -> None:
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, "-c", PROGRAM])
    read_until(terminal, lambda text: "ready" in text)
    for keys in (b" ", b"\x1b[Cn", b"\x1b[A\x1b[B"):
        os.write(terminal, keys)
    text = read_until(terminal, lambda text: "]" in text and text.endswith("\n"))
    os.waitpid(process, 0)
    os.close(terminal)
    assert "True [' ', 'right', 'n', 'up', 'down'] True" in text


def test_without_a_terminal_there_are_no_keys() -> None:
    program = "from knee_gap_core.node.keyboard import keys\nwith keys(print) as heard:\n    print(heard)"
    done = subprocess.run(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, capture_output=True, text=True, check=True
    )
    assert done.stdout == "False\n"
