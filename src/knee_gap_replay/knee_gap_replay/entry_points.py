"""Entry points of the package's executables. They can be stopped while their modules are imported."""

from knee_gap_core.node.entry import entry

check = entry("knee_gap_replay.check")
evaluate = entry("knee_gap_replay.evaluation.command")
import_motive = entry("knee_gap_replay.import_motive")
play = entry("knee_gap_replay.play_node", node=True)
process = entry("knee_gap_replay.process")
record = entry("knee_gap_replay.record_node", node=True)
report = entry("knee_gap_replay.report.command")
