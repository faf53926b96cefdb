"""Group of child processes: started together, awaited until ready, and ended by their own ids."""

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
from knee_gap_core.values.errors import KneeGapError

# Logged by every node once it can receive messages.
READY = "ready"
# Time allowed for a process to end after a request [s].
GRACE = 10.0


class StartError(KneeGapError):
    """A process did not start, or ended too early; the message names it and quotes its last line.

    `code` is the exit code of the command: that of the process, or 1 if it has none or ended with 0.
    """

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = exit_code_of(code) or 1


def executable(package: str, name: str) -> str:
    """Path of an executable as `ros2 run` would find it."""
    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Processes:
    """Named processes, each with a log file. Leaving the context ends those that are still running."""

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
                # A Ctrl-C in the terminal goes to the parent only, which then ends these in order.
                start_new_session=True,
            )

    def log(self, name: str) -> Path:
        """Log file of a process."""
        return self._log_folder / f"{name}.log"

    def pid(self, name: str) -> int:
        """Process id."""
        return self._running[name].pid

    def wait_ready(self, names: Sequence[str], timeout: float) -> None:
        """Return once each process has logged that it is ready. Raises StartError."""
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
        """Last line of a process's output."""
        lines = self.log(name).read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "(no output)"

    def wait(self, name: str, beside: Sequence[str] = ()) -> int:
        """Wait until a process ends by itself; return its exit code.

        Raises StartError if one of `beside` ends before.
        """
        while self._running[name].poll() is None:
            for other in beside:
                self.check(other)
            time.sleep(0.02)
        return self._running.pop(name).wait()

    def end(self, name: str) -> int:
        """Ask a process to end, and kill it if it does not; return its exit code."""
        process = self._running.pop(name)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            return process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()
