"""Entry points of the package's executables. They can be stopped while their modules are imported."""

from knee_gap_core.node.entry import entry

calibrate = entry("knee_gap_perception.calibrate.command")
mark = entry("knee_gap_perception.marks.command")
segmentation_node = entry("knee_gap_perception.segmentation_node", node=True)
tracker_precision = entry("knee_gap_perception.tracker_precision.command")
tracking_node = entry("knee_gap_perception.tracking_node", node=True)
train_segmentation = entry("knee_gap_perception.training.command")
