"""Speed of `process` on the sample bag, in one process and in two, beside its floor: decoding the images.

Processor seconds for each second of video, by stage; "at best" is the rate, in times real time, that two idle
cores could reach with these stages. The time on the clock is of this machine as busy as it is.
"""

import multiprocessing
import resource
import shutil
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

from knee_gap_core.bag.bag import BagReader
from knee_gap_perception.edge_tracking.edge_stream import read_image
from knee_gap_replay.whole_bags.one_bag import Job, process_one

SAMPLE = Path(__file__).parents[1] / "bags" / "sample"
IMAGE = "/knee_gap/image_raw/compressed"


def floor_of(bag: Path) -> tuple[float, float]:
    """Return the processor time that decoding the images takes, and the length of the video [s]."""
    with BagReader(bag) as reader:
        messages = list(reader.messages([IMAGE]))
        images = [reader.deserialize(message) for message in messages]
    begun = time.process_time()
    for image in images:
        read_image(image)
    return time.process_time() - begun, (messages[-1].time_ns - messages[0].time_ns) * 1e-9


def measure(bag: Path, workers: int, out: Path) -> tuple[float, float, float]:
    """Return the processor times of this process and of its child, and the time on the clock [s]."""
    before, begun = time.process_time(), time.monotonic()
    process_one(Job(str(bag), str(out)), workers)
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() - before, child.ru_utime + child.ru_stime, time.monotonic() - begun


def _measured(bag: Path, workers: int, out: Path, connection: Connection) -> None:
    connection.send(measure(bag, workers, out))


def main() -> int:
    """Print the table."""
    fork = multiprocessing.get_context("fork")
    floor, seconds = floor_of(SAMPLE)
    folder = Path(tempfile.mkdtemp())
    print(f"{seconds:.1f} s of video; decoding alone {floor / seconds:.2f} processor s each second")
    heads = ("workers", "first stage", "second stage", "sum", "/ floor", "at best", "clock")
    widths = (8, 13, 14, 7, 9, 9, 8)
    print("".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)))
    try:
        # The first run is not counted: it may compile kernels.
        for number, workers in enumerate((1, 1, 2)):
            ours, theirs = fork.Pipe(duplex=False)
            child = fork.Process(target=_measured, args=(SAMPLE, workers, folder / str(number), theirs))
            child.start()
            second, first, clock = ours.recv()
            child.join()
            if number == 0:
                continue
            total = first + second
            best = seconds / max(first, second, total / 2) if workers > 1 else seconds / total
            shown = (first if workers > 1 else 0.0, second, total)
            print(
                f"{workers:8d}{shown[0] / seconds:13.2f}{shown[1] / seconds:14.2f}{shown[2] / seconds:7.2f}"
                f"{total / floor:9.1f}{best:9.2f}{seconds / clock:8.2f}"
            )
    finally:
        shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    main()
