"""Processes of the suite, started together, heard when they are ready, and ended by their own id."""

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from ament_index_python.packages import get_package_prefix

from knee_gap_bringup.launching.plan import exit_code_of

# What every node logs once it can take messages.
READY = "ready"
# Time a process has to end after it was asked to [s].
GRACE = 10.0


class StartError(RuntimeError):
    """A process did not come up, or ended before its time; the message says which and its last words.

    `code` is what the whole ends with: the process's own exit code, 1 where it has none or ended with 0.
    """

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = exit_code_of(code) or 1


def executable(package: str, name: str) -> str:
    """Path of an executable as `ros2 run` would find it."""
    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Processes:
    """Named processes, each with a log file; leaving the context ends those that still run."""

    def __init__(self, log_folder: Path, environment: Mapping[str, str]) -> None:
        self._log_folder = log_folder
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name in reversed(list(self._running)):
            self.end(name)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a command; its output goes to `<name>.log`."""
        with self.log(name).open("wb") as log:
            self._running[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                # A Ctrl-C in the terminal is for whoever started these, who then ends them in order.
                start_new_session=True,
            )

    def log(self, name: str) -> Path:
        """Where a process's output goes."""
        return self._log_folder / f"{name}.log"

    def pid(self, name: str) -> int:
        """Process id."""
        return self._running[name].pid

    def wait_ready(self, names: Sequence[str], timeout: float) -> None:
        """Return once each process has said that it is ready. Raises StartError."""
        deadline = time.monotonic() + timeout
        for name in names:
            while READY not in self.log(name).read_text(errors="replace"):
                self.check(name)
                if time.monotonic() > deadline:
                    raise StartError(f"{name} is not ready after {timeout:g} s")
                time.sleep(0.02)

    def check(self, name: str) -> None:
        """Raise StartError if a process has ended."""
        code = self._running[name].poll()
        if code is not None:
            raise StartError(f"{name} ended with exit code {code}: {self.last_words(name)}", code)

    def last_words(self, name: str) -> str:
        """Last line that a process wrote."""
        lines = self.log(name).read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "(it said nothing)"

    def wait(self, name: str, beside: Sequence[str] = ()) -> int:
        """Wait until a process ends by itself; return its exit code.

        Raises StartError if one of `beside` ends meanwhile.
        """
        while self._running[name].poll() is None:
            for other in beside:
                self.check(other)
            time.sleep(0.02)
        return self._running.pop(name).wait()

    def end(self, name: str) -> int:
        """Ask a process to end, kill it if it does not; return its exit code."""
        process = self._running.pop(name)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            return process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()
