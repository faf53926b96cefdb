"""Supervisor that runs a plan without the package launch: starts, restarts and ends its processes."""

import signal
import subprocess
import time
from collections.abc import Callable, Sequence

from knee_gap_bringup.launching.plan import (
    DRAIN,
    RESPAWN_DELAY,
    Next,
    PlannedProcess,
    Reaction,
    exit_code_of,
    reaction,
)
from knee_gap_bringup.launching.processes import GRACE, executable

STOPS = (signal.SIGINT, signal.SIGTERM)
LOOK = 0.05


def supervise(
    plan: Sequence[PlannedProcess],
    *,
    tell: Callable[[str], None],
    respawn_delay: float = RESPAWN_DELAY,
    stopped_code: int = 0,
) -> int:
    """Run a plan to its end; return 0, or the exit code of the process that failed.

    `tell` is called with one line for each start and end. On SIGINT and SIGTERM, all processes are ended in
    order, and `stopped_code` is returned.
    """
    supervisor = _Supervisor(plan, tell, respawn_delay, stopped_code)
    try:
        return supervisor.run()
    finally:
        supervisor.end()


class _Supervisor:
    def __init__(
        self,
        plan: Sequence[PlannedProcess],
        tell: Callable[[str], None],
        respawn_delay: float,
        stopped_code: int,
    ) -> None:
        self._plan, self._tell = plan, tell
        self._respawn_delay, self._stopped_code = respawn_delay, stopped_code
        self._running: dict[int, subprocess.Popen[bytes]] = {}
        # Times of the next restarts, and of the shutdown after the last image; monotonic clock [s].
        self._due: dict[int, float] = {}
        self._end_at = float("inf")
        self._stop = False
        for number in STOPS:
            signal.signal(number, self._on_signal)

    def run(self) -> int:
        for index in range(len(self._plan)):
            if not self._stop:
                self._start(index)
        while not self._stop:
            now = time.monotonic()
            if now >= self._end_at:
                return self.end()
            for index in [index for index, due in self._due.items() if now >= due]:
                del self._due[index]
                self._start(index)
            for index, process in list(self._running.items()):
                if (code := process.poll()) is not None:
                    del self._running[index]
                    answer = reaction(self._plan[index], code)
                    if answer.next is Next.END:
                        self._tell(f"{answer.words}; stopping all")
                        self.end()
                        return answer.code
                    self._follow(index, answer)
            time.sleep(LOOK)
        self._tell("stopped")
        return self.end() or self._stopped_code

    def end(self) -> int:
        """End all running processes at once; return the exit code of one that failed."""
        code, began = 0, time.monotonic()
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for index, process in self._running.items():
            try:
                ended = process.wait(max(GRACE - (time.monotonic() - began), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                ended = process.wait()
                self._tell(f"{self._plan[index].executable} did not end within {GRACE:g} s and was killed")
            answer = reaction(self._plan[index], ended, ending=True)
            if answer.code:
                self._tell(answer.words)
            code = code or exit_code_of(answer.code)
        self._running.clear()
        return code

    def _follow(self, index: int, answer: Reaction) -> None:
        now = time.monotonic()
        if answer.next is Next.START_AGAIN:
            self._tell(f"{answer.words}; restart in {self._respawn_delay:g} s")
            self._due[index] = now + self._respawn_delay
        elif answer.next is Next.END_AFTER_DRAIN:
            self._end_at = now + DRAIN

    def _start(self, index: int) -> None:
        planned = self._plan[index]
        command = [
            executable(planned.package, planned.executable),
            *planned.arguments,
            *planned.ros_arguments,
        ]
        # A signal that arrives before the process can handle it stays pending; its entry point unblocks it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
        try:
            # A Ctrl-C in the terminal goes to this process only, which then ends the others in order.
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._running[index] = process
        self._tell(f"{planned.executable} started, process {process.pid}")

    def _on_signal(self, _number: int, _frame: object) -> None:
        self._stop = True
