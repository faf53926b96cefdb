"""Entry points of the package's executables, which can be stopped while their modules are imported."""

from knee_gap_core.node.entry import entry

coverage = entry("knee_gap_uncertainty.studies.coverage.command")
joint_motion_table = entry("knee_gap_uncertainty.studies.joint_motion.table")
study = entry("knee_gap_uncertainty.studies.paper.command")
uncertainty_node = entry("knee_gap_uncertainty.uncertainty_node", node=True)
