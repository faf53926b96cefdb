"""suite_node: tracking_node, segmentation_node and uncertainty_node in one process, with less to calculate.

Messages pass from one to the next directly. Topics, parameters and names of the nodes are those of three
processes, and what other processes listen to is published; but poses and edges that another process publishes
under these names are not received.
"""

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node

from knee_gap_core.live.base_node import GuardedNode, run_all
from knee_gap_core.live.local_topics import LocalTopics
from knee_gap_perception.segmentation_node import SegmentationNode
from knee_gap_perception.tracking_node import TrackingNode
from knee_gap_uncertainty.uncertainty_node import UncertaintyNode

BETWEEN = ("gap_edges", "scope_pose", "scope_rotation", "scope_notch")
# Each before those that it listens to.
NODES: tuple[Callable[[], Any], ...] = (UncertaintyNode, SegmentationNode, TrackingNode)


def first_node() -> Any:
    """The first of the nodes, after the topics between them were named in their namespace."""
    namespace = Node("suite_node")
    GuardedNode.local = LocalTopics(namespace.resolve_topic_name(topic) for topic in BETWEEN)
    namespace.destroy_node()
    return NODES[0]()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the nodes."""
    return run_all([first_node, *NODES[1:]], argv)
