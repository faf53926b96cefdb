"""The topics of knee_gap in a bag."""

import argparse
from collections.abc import Collection
from typing import NamedTuple


class InputTopics(NamedTuple):
    """Where the inputs are."""

    image: str
    camera_info: str
    body_pose: str


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say under which names a bag has the inputs."""
    parser.add_argument("--namespace", default="/knee_gap", metavar="NAME", help="of the topics (/knee_gap)")
    parser.add_argument(
        "--image", metavar="TOPIC", help="images (NAMESPACE/image_raw/compressed, or image_raw)"
    )
    parser.add_argument("--camera-info", metavar="TOPIC", help="camera model (NAMESPACE/camera_info)")
    parser.add_argument(
        "--pose", metavar="TOPIC", help="tracked body of the scope (NAMESPACE/scope_body/pose)"
    )


def topics_from(arguments: argparse.Namespace, available: Collection[str]) -> InputTopics:
    """Return the topics that the arguments name; of compressed and raw images, those that are `available`."""
    space = namespace_from(arguments)
    compressed, raw = f"{space}/image_raw/compressed", f"{space}/image_raw"
    return InputTopics(
        image=arguments.image or (raw if raw in available and compressed not in available else compressed),
        camera_info=arguments.camera_info or f"{space}/camera_info",
        body_pose=arguments.pose or f"{space}/scope_body/pose",
    )


def namespace_from(arguments: argparse.Namespace) -> str:
    """Return the namespace with one leading slash and none behind, empty for the root."""
    name = str(arguments.namespace).strip("/")
    return f"/{name}" if name else ""
