"""One bag processed into a bag of results."""

import argparse
from pathlib import Path
from typing import NamedTuple

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_replay.pipeline import GapPipeline
from knee_gap_replay.processing import process
from knee_gap_replay.topics import choices, topics_from
from knee_gap_replay.whole_bags.output import refuse_input_as_output
from knee_gap_replay.whole_bags.overlapped import process_overlapped, usable_cores

# Files that a bag folder may contain: the calibration of its scope, or parameters for its scope.
_CALIBRATION, _BESIDE = "calibration.yaml", "scope.yaml"


class Job(NamedTuple):
    """What is to be processed, and how; `topics`: image, camera model and pose (None: by default)."""

    bag: str
    out: str
    replace: bool = False
    params_file: str | None = None
    namespace: str = "/knee_gap"
    topics: tuple[str | None, str | None, str | None] = (None, None, None)
    with_mask: bool = False


class Result(NamedTuple):
    """Lines to print, exit code, and the number of results by topic."""

    lines: list[str]
    exit_code: int
    counts: dict[str, int]
    losses: int


def process_one(job: Job, workers: int | None = None) -> Result:
    """Process a bag. Raises BagError and OSError if it cannot be done at all."""
    lines = []
    with BagReader(job.bag) as reader:
        if reader.renamed:
            lines.append(reader.renamed)
        image, camera_info, pose = job.topics
        named = argparse.Namespace(namespace=job.namespace, image=image, camera_info=camera_info, pose=pose)
        topics = topics_from(named, reader.topics)
        if missing := [topic for topic in topics if topic not in reader.topics]:
            names = ", ".join(sorted(reader.topics)) or "none"
            hint = f"; {hint}" if (hint := choices(reader.topics, topics)) else ""
            raise BagError(f"{reader.path} has no topic {', '.join(missing)}; it has {names}{hint}")
        pipeline = GapPipeline.from_parameters(
            _parameters(job), topics, job.namespace, with_mask=job.with_mask
        )
        reader.messages(pipeline.inputs)  # raises for a bag without them before anything is written
        refuse_input_as_output(job.bag, job.out)
        with BagWriter(job.out, metadata=reader.metadata, replace=job.replace) as writer:
            if (workers or usable_cores()) > 1:
                flaws, unread = process_overlapped(reader, writer, pipeline)
            else:
                process(reader, writer, pipeline)
                flaws, unread = pipeline.flaws(), pipeline.unread()
            counts = dict(writer.counts)
        losses = len(reader.losses)
    summary = ", ".join(f"{count} {topic}" for topic, count in counts.items())
    lines += [*flaws, f"{summary} in {job.out}"]
    if unread:
        lines.append(f"no image on {topics.image} could be read: {unread}")
    return Result(lines, 1 if unread else 0, counts, losses)


def _parameters(job: Job) -> ParametersFile:
    """Parameters from the named file, else from the files in the bag folder."""
    if job.params_file is not None:
        return ParametersFile(Path(job.params_file))
    bag = Path(job.bag)
    folder = bag if bag.is_dir() else bag.parent
    if (folder / _CALIBRATION).is_file():
        return ParametersFile.with_calibration(folder / _CALIBRATION)
    return ParametersFile(folder / _BESIDE if (folder / _BESIDE).is_file() else None)
