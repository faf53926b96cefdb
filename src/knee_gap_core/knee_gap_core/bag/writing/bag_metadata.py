"""The `metadata.yaml` of a bag, in version 9 of rosbag2."""

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9
from ruamel.yaml import YAML

VERSION = 9
_DISTRIBUTION = "jazzy"


class FileSummary(NamedTuple):
    """One file of a bag; times [ns]."""

    name: str
    start_ns: int
    end_ns: int
    message_count: int


class TopicSummary(NamedTuple):
    """One topic of a bag."""

    name: str
    msgtype: str
    qos: Sequence[Qos]
    type_hash: str
    serialization: str
    message_count: int


def information(
    files: Sequence[FileSummary], topics: Sequence[TopicSummary], custom: Mapping[str, str], *, named: bool
) -> dict[str, Any]:
    """Return what metadata.yaml holds under its one key.

    Not `named`, it does not hold the names of the files: the copy inside a file then has the same bytes
    wherever the bag lies. rosbag2 takes them from the file that it opens.
    """
    used = [file for file in files if file.message_count]
    start_ns = min((file.start_ns for file in used), default=0)
    end_ns = max((file.end_ns for file in used), default=0)
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files] if named else [],
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": sum(file.message_count for file in files),
        "topics_with_message_count": [_topic(topic) for topic in topics],
        "compression_format": "",
        "compression_mode": "",
        "files": [_file(file) for file in files] if named else [],
        "custom_data": dict(custom) or None,
        "ros_distro": _DISTRIBUTION,
    }


def yaml_text(value: Any) -> str:
    """Return a value as YAML."""
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    stream = StringIO()
    yaml.dump(value, stream)
    return stream.getvalue()


def qos_text(profiles: Sequence[Qos]) -> str:
    """Return profiles as the metadata of a channel keeps them."""
    return yaml_text(dump_qos_v9(list(profiles))).strip()


def write_metadata(folder: Path, held: Mapping[str, Any]) -> None:
    """Write metadata.yaml whole or not at all."""
    draft = folder / "metadata.yaml.tmp"
    try:
        draft.write_text(yaml_text({"rosbag2_bagfile_information": dict(held)}), encoding="utf-8")
        draft.replace(folder / "metadata.yaml")
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def _file(file: FileSummary) -> dict[str, Any]:
    return {
        "path": file.name,
        "starting_time": {"nanoseconds_since_epoch": file.start_ns},
        "duration": {"nanoseconds": file.end_ns - file.start_ns},
        "message_count": file.message_count,
    }


def _topic(topic: TopicSummary) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": topic.name,
            "type": topic.msgtype,
            "serialization_format": topic.serialization,
            "offered_qos_profiles": dump_qos_v9(list(topic.qos)),
            "type_description_hash": topic.type_hash,
        },
        "message_count": topic.message_count,
    }
