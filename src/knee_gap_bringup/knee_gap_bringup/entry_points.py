"""Entry points of the package's executables. They can be stopped while their modules are imported."""

from knee_gap_core.node.entry import entry

closed_loop = entry("knee_gap_bringup.closed_loop.command")
demo = entry("knee_gap_bringup.demo")
leg_controller_node = entry("knee_gap_bringup.leg_controller_node", node=True)
live = entry("knee_gap_bringup.launching.live_command")
replay = entry("knee_gap_bringup.launching.replay_command")
suite_node = entry("knee_gap_bringup.suite_node", node=True)
