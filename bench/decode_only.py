"""A bare subscriber for bench_transport and bench_load: it decodes compressed images and answers each."""

import sys
from collections.abc import Mapping

import rclpy
from sensor_msgs.msg import CompressedImage

from knee_gap_core.live.base_node import IMAGE_QOS, RESULT_QOS, BaseNode, run
from knee_gap_msgs.msg import GapEdges
from knee_gap_perception.messages import image_from_compressed


class DecodeOnlyNode(BaseNode):
    """Answers each image with its header."""

    def __init__(self) -> None:
        super().__init__("decode_only", health=self.health)
        self._edges = self.create_publisher(GapEdges, "gap_edges", RESULT_QOS)
        self.create_subscription(CompressedImage, "image_raw/compressed", self.on_image, IMAGE_QOS)

    def on_image(self, message: CompressedImage) -> None:
        """Decode and answer."""
        image_from_compressed(message)
        self._edges.publish(GapEdges(header=message.header))

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """Nothing to report."""
        return rclpy.ok(), "", {}


if __name__ == "__main__":
    sys.exit(run(DecodeOnlyNode))
