"""segmentation_node: images of the scope in; gap_edges, the two points beside the gap, out."""

from collections.abc import Mapping, Sequence

import numpy as np
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from knee_gap_msgs.msg import GapEdges
from knee_gap_node.base_node import IMAGE_QOS, RESULT_QOS, BaseNode, run
from knee_gap_perception.edge_parameters import EdgeParameters
from knee_gap_perception.edge_stream import EdgeStream
from knee_gap_perception.edges import EdgeStatus
from knee_gap_perception.messages import fill_gap_edges
from knee_gap_perception.segmentation_parameters import TransportParameters


class SegmentationNode(BaseNode):
    """Converts, calls the core, publishes; the mask is computed only while somebody listens."""

    def __init__(self) -> None:
        super().__init__("segmentation_node", health=self.health)
        transport = self.declare(TransportParameters).image_transport
        self._stream = EdgeStream(self.declare(EdgeParameters))
        self.refuse_unknown_parameters()
        self._dropped = 0
        self._sequence: int | None = None
        self._edges = self.create_publisher(GapEdges, "gap_edges", RESULT_QOS)
        self._mask = self.create_publisher(Image, "gap_mask", IMAGE_QOS)
        kind, topic = {
            "raw": (Image, "image_raw"),
            "compressed": (CompressedImage, "image_raw/compressed"),
        }[transport]
        self.create_subscription(CameraInfo, "camera_info", self._stream.on_camera_info, IMAGE_QOS)
        self.create_subscription(PointStamped, "clicked_point", self.on_click, RESULT_QOS)
        self.create_subscription(kind, topic, self.on_image, IMAGE_QOS)

    def on_image(self, message: Image | CompressedImage, info: Mapping[str, int | None]) -> None:
        """Publish the edges in an image, and the mask if anybody wants it."""
        self.count_dropped(info.get("publication_sequence_number"))
        edges = self._stream.on_image(message)
        self._edges.publish(fill_gap_edges(GapEdges(), edges))
        if self._stream.reason:
            self.log_once(edges.status.name, f"{edges.status.name}: {self._stream.reason}")
        if self._mask.get_subscription_count():
            self.publish_mask(message)

    def on_click(self, message: PointStamped) -> None:
        """Choose the section of the gap nearest to a pixel (x column, y row) of the next image."""
        self._stream.detector.choose_at(np.array([message.point.x, message.point.y]))

    def publish_mask(self, image: Image | CompressedImage) -> None:
        """Publish the gap of the last image as mono8, 255 where it is."""
        mask = self._stream.detector.gap_mask()
        message = Image(header=image.header, height=mask.shape[0], width=mask.shape[1], encoding="mono8")
        message.step = mask.shape[1]
        message.data = mask.tobytes()
        self._mask.publish(message)

    def count_dropped(self, number: int | None) -> None:
        """Count the images that the middleware skipped because newer ones were waiting."""
        if number is not None and self._sequence is not None and number > self._sequence + 1:
            self._dropped += number - self._sequence - 1
        self._sequence = number

    def health(self) -> tuple[bool, str, Mapping[str, object]]:
        """Status of the latest image, and how often each status came."""
        latest = self._stream.latest
        well = latest is not None and latest.status is EdgeStatus.VALID
        return well, self._stream.reason, {**self._stream.counts, "images dropped": self._dropped}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(SegmentationNode, argv)
