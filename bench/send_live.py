"""Camera and tracker of bench_load: a bag's messages, sent with present stamps to one scope or several.

The stamps [ns] of the images are written as JSON.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from live_messages import LATENCY, Played, of_bag, to_and_fro, with_stamp
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage

from knee_gap_simulation.recordings.recording import BODY_POSE, CAMERA_INFO, IMAGE

KINDS = {IMAGE: CompressedImage, CAMERA_INFO: CameraInfo, BODY_POSE: PoseStamped}
# For publishers and subscribers to find each other [s].
SETTLE = 2.0


def main(argv: Sequence[str] | None = None) -> int:
    """Send."""
    parser = argparse.ArgumentParser(prog="send_live", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bag", type=Path)
    parser.add_argument("stamps", type=Path, help="the file of stamps to write")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rows", type=int, default=0, help="height of the images; 0 is the bag's")
    parser.add_argument("--namespaces", nargs="+", default=["/knee_gap"])
    asked = parser.parse_args(argv)
    script = list(to_and_fro(of_bag(asked.bag, asked.rows), asked.seconds))
    script.sort(key=lambda one: one.stamp + LATENCY[one.topic])
    rclpy.init()
    node = Node("send_live")
    # Reliable, as `play` offers: what the nodes' best-effort subscriptions lose is theirs.
    qos = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
    outlets = {
        topic: [
            node.create_publisher(kind, space + topic.removeprefix("/knee_gap"), qos)
            for space in asked.namespaces
        ]
        for topic, kind in KINDS.items()
    }
    print("ready", flush=True)
    time.sleep(SETTLE)
    begin_ns = time.time_ns()
    offset = time.monotonic() - 1e-9 * begin_ns
    for one in script:
        wait(begin_ns * 1e-9 + offset + one.stamp + LATENCY[one.topic])
        data = with_stamp(one.data, stamp_of(one, begin_ns))
        for outlet in outlets[one.topic]:
            outlet.publish(data)
    asked.stamps.write_text(json.dumps([stamp_of(one, begin_ns) for one in script if one.topic == IMAGE]))
    node.destroy_node()
    rclpy.shutdown()
    return 0


def stamp_of(one: Played, begin_ns: int) -> int:
    """The present stamp [ns] of a message."""
    return begin_ns + round(one.stamp * 1e9)


def wait(due: float) -> None:
    """Wait until a monotonic time [s]."""
    if (left := due - time.monotonic()) > 0.0:
        time.sleep(left)


if __name__ == "__main__":
    sys.exit(main())
