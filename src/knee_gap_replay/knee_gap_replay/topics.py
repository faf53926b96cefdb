"""Names of knee_gap's input topics in a bag, and the command line arguments that set them."""

import argparse
from collections.abc import Collection, Mapping
from typing import NamedTuple


class InputTopics(NamedTuple):
    """Names of the input topics."""

    image: str
    camera_info: str
    body_pose: str


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that set the names of the input topics."""
    parser.add_argument("--namespace", default="/knee_gap", metavar="NAME", help="namespace (/knee_gap)")
    parser.add_argument(
        "--image", metavar="TOPIC", help="images (NAMESPACE/image_raw/compressed, or image_raw)"
    )
    parser.add_argument("--camera-info", metavar="TOPIC", help="camera model (NAMESPACE/camera_info)")
    parser.add_argument(
        "--pose", metavar="TOPIC", help="pose of the scope's tracked body (NAMESPACE/scope_body/pose)"
    )


def topics_from(arguments: argparse.Namespace, available: Collection[str]) -> InputTopics:
    """Return the topics that the arguments name; of compressed and raw images, the `available` topic."""
    space = namespace_from(arguments)
    compressed, raw = f"{space}/image_raw/compressed", f"{space}/image_raw"
    return InputTopics(
        image=arguments.image or (raw if raw in available and compressed not in available else compressed),
        camera_info=arguments.camera_info or f"{space}/camera_info",
        body_pose=arguments.pose or f"{space}/scope_body/pose",
    )


def choices(available: Mapping[str, str], topics: InputTopics) -> str:
    """Return the option for each missing input and the topics (name: type) that may be meant by it."""
    words = []
    for name, option, types in (
        (topics.image, "--image", ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")),
        (topics.camera_info, "--camera-info", ("sensor_msgs/msg/CameraInfo",)),
        (topics.body_pose, "--pose", ("geometry_msgs/msg/PoseStamped",)),
    ):
        if name not in available and (found := sorted(n for n, kind in available.items() if kind in types)):
            words.append(f"{option} {' or '.join(found)}")
    return f"choose with {', '.join(words)}" if words else ""


def namespace_from(arguments: argparse.Namespace) -> str:
    """Return the namespace with a leading and without a trailing slash; empty for the root."""
    name = str(arguments.namespace).strip("/")
    return f"/{name}" if name else ""
