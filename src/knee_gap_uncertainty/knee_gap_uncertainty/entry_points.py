"""Entry points of the package's executables, which can be stopped while their modules are imported."""

from knee_gap_node.entry import entry

coverage = entry("knee_gap_uncertainty.coverage.command")
joint_motion_table = entry("knee_gap_uncertainty.joint_motion_table")
study = entry("knee_gap_uncertainty.study.command")
uncertainty_node = entry("knee_gap_uncertainty.uncertainty_node", node=True)
