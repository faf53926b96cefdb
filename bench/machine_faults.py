"""Faults of the machine for bench_live_faults: cores that are busy, a disk that is full."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

from live_faults import EDGES

from knee_gap_bringup.launching.processes import Processes, executable
from knee_gap_core.bag.bag import BagReader
from knee_gap_simulation.recordings.recording import IMAGE

GAP = "/knee_gap/gap"
# Free space on the disk when the fault begins [bytes].
LEFT = 300_000
SAID = ("recording goes on in memory", "there is space again")


class BusyCores:
    """A busy loop for each core, at the nodes' own priority."""

    def __init__(self) -> None:
        self._loops: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def begin(self) -> None:
        """Start the loops."""
        command = [sys.executable, "-c", "while True: pass"]
        self._loops += [subprocess.Popen(command) for _ in os.sched_getaffinity(0)]

    def end(self) -> None:
        """End the loops."""
        while self._loops:
            loop = self._loops.pop()
            loop.kill()
            loop.wait()


class FullDisk:
    """A recorder of images, edges and estimates whose files may not grow for a while.

    A limit on the size of its files is to the recorder what a full disk is, and needs no disk. After the
    context, `flaw` says what the recorder did wrong; empty if it said that the disk was full, went on, and
    kept all that it received.
    """

    def __init__(self, processes: Processes, folder: Path) -> None:
        self.flaw = ""
        self._processes, self._out = processes, folder / "recorded"

    def __enter__(self) -> Self:
        command = [executable("knee_gap_replay", "record"), "--force", str(self._out), IMAGE, EDGES, GAP]
        self._processes.start("record", command)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        code = self._processes.end("record")
        said = self._processes.log("record").read_text(errors="replace")
        missing = [words for words in SAID if words not in said]
        if code != 0:
            self.flaw = f"record ended with {code}: {said.strip().splitlines()[-1]}"
        elif missing:
            self.flaw = f"record did not say: {missing[0]}"
        else:
            with BagReader(self._out) as reader:
                kept = sum(1 for _ in reader.messages([IMAGE]))
                if reader.losses or not kept:
                    self.flaw = f"the recording is damaged: {', '.join(reader.losses) or 'no image in it'}"

    def begin(self) -> None:
        """Let the disk be full."""
        size = sum(path.stat().st_size for path in self._out.glob("*.mcap"))
        self._limit(size + LEFT)

    def end(self) -> None:
        """Let there be space again."""
        self._limit(resource.RLIM_INFINITY)

    def _limit(self, most_bytes: int) -> None:
        pid = self._processes.pid("record")
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (most_bytes, hard))
