"""Entry points of the package's executables. They can be stopped while their modules are imported."""

from knee_gap_core.node.entry import entry

compare_looks = entry("knee_gap_simulation.look_checks.compare_looks")
contact_sheet = entry("knee_gap_simulation.look_checks.contact_sheet")
make_bag = entry("knee_gap_simulation.make_bag.command")
natnet_server = entry("knee_gap_simulation.natnet.command")
render_examples = entry("knee_gap_simulation.render_examples")
