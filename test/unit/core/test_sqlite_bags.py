"""Bags in rosbag2's former storage are read like any other, damaged ones too."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.interfaces import QosReliability
from rosbags.rosbag2 import StoragePlugin, Writer

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank, typestore
from knee_gap_core.bag.qos import PROFILES

POSE, EMPTY = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Empty"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """1000 poses, three of each time, out of order, and two empty messages."""
    path = tmp_path / "old"
    rng = np.random.default_rng(3)
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        pose = writer.add_connection(
            "/pose", POSE, typestore=typestore(), offered_qos_profiles=[PROFILES["sensor"]]
        )
        empty = writer.add_connection("/empty", EMPTY, typestore=typestore())
        for index in rng.permutation(1000):
            message = blank(POSE)
            message.header.stamp.nanosec = int(index)
            writer.write(pose, int(index) // 3 * 1000, bytes(typestore().serialize_cdr(message, POSE)))
        for data in (bytes([0, 1, 0, 0, 0]), bytes([0, 1, 0, 0])):
            writer.write(empty, 5, data)
    return path


@pytest.mark.parametrize("bare", [False, True])
def test_every_message_is_given_in_order_of_time(bag: Path, bare: bool) -> None:
    with BagReader(bag / "old.db3" if bare else bag) as reader:
        assert reader.topics == {"/pose": POSE, "/empty": EMPTY}
        assert reader.count() == 1002
        assert reader.details["/pose"].qos[0].reliability == QosReliability.BEST_EFFORT
        messages = list(reader.messages())
        times = [message.time_ns for message in messages]
        assert times == sorted(times)
        poses = [message for message in messages if message.topic == "/pose"]
        assert sorted(reader.stamp_ns(message) or 0 for message in poses) == list(range(1000))
        assert len(list(reader.messages(["/empty"]))) == 2
        for message in reader.messages(["/empty"]):
            reader.deserialize(message)
            assert reader.stamp_ns(message) is None
        assert not reader.losses


def test_a_bag_without_metadata_is_found_by_its_files(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    with BagReader(bag) as reader:
        assert len(list(reader.messages())) == 1002


def test_damage_ends_in_a_line_never_in_a_traceback(bag: Path, tmp_path: Path) -> None:
    content = (bag / "old.db3").read_bytes()
    rng = np.random.default_rng(4)
    refused = 0
    for number in range(40):
        damaged = bytearray(content)
        if number < 10:
            del damaged[len(damaged) * number // 10 :]
        else:
            for place in rng.integers(0, len(damaged), 30):
                damaged[place] ^= 0xFF
        path = tmp_path / "damaged.db3"
        path.write_bytes(bytes(damaged))
        try:
            with BagReader(path) as reader:
                list(reader.messages())
                assert all(line.count("\n") == 0 for line in reader.losses)
        except BagError:
            refused += 1
    assert refused < 40


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.db3").write_text("these are not the bytes of a bag")
    with pytest.raises(BagError, match="is not an SQLite file"):
        BagReader(tmp_path / "text.db3")
    (tmp_path / "empty.db3").write_bytes(b"")
    with pytest.raises(BagError, match="is empty"):
        BagReader(tmp_path / "empty.db3")
