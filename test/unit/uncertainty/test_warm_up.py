"""After warming up nothing is compiled any more: a live estimate is not late."""

import subprocess
import sys

from sample_bag import SAMPLE

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_uncertainty.estimation.warm_up import warm_up

COUNT_LATE = """
import numba.core.dispatcher as dispatcher
from knee_gap_uncertainty.estimation.warm_up import warm_up
warm_up()
late = []
original = dispatcher.Dispatcher.compile
def compile_and_tell(self, sig):
    late.append(f"{self.py_func.__name__}{sig}")
    return original(self, sig)
dispatcher.Dispatcher.compile = compile_and_tell
from knee_gap_core.bag.bag import BagReader
from knee_gap_core.node.parameters_file import ParametersFile
from knee_gap_replay.pipeline import GapPipeline
from knee_gap_replay.processing import by_stamp
from knee_gap_replay.topics import InputTopics
from pathlib import Path
import sys
from knee_gap_perception.edge_tracking.warm_up import warm_up as warm_up_perception
warm_up_perception()
late.clear()
bag = Path(sys.argv[1])
topics = InputTopics("/knee_gap/image_raw/compressed", "/knee_gap/camera_info", "/knee_gap/scope_body/pose")
pipeline = GapPipeline.from_parameters(ParametersFile(bag / "scope.yaml"), topics, "/knee_gap")
with BagReader(bag) as reader:
    for number, stamped in enumerate(by_stamp(reader, pipeline.inputs)):
        message = reader.deserialize(stamped.message)
        list(pipeline.feed(stamped.message.topic, message, stamped.stamp_ns))
        if number > 700:
            break
print(*late, sep="\\n")
"""


def test_the_short_track_goes_through_what_a_long_one_may() -> None:
    assert GapStatus.VALID in warm_up()


def test_nothing_is_compiled_while_the_sample_bag_is_processed() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COUNT_LATE, str(SAMPLE)], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ""
