"""What is written is what any reader of bags reads."""

import filecmp
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability, QosReliability

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.mcap_file import Block, Entry, McapFile
from knee_gap_core.bag.message_types import blank, typestore
from knee_gap_core.values.stamps import set_stamp

POSE = "geometry_msgs/msg/PoseStamped"
EDGES = "knee_gap_msgs/msg/GapEdges"


def pose(stamp_ns: int) -> Any:
    message = blank(POSE)
    set_stamp(message.header, stamp_ns)
    message.header.frame_id = "world"
    message.pose.position.x = stamp_ns * 1e-9
    return message


def write(path: Path) -> None:
    with BagWriter(path, metadata={"scene": '{"gap_mm": 4}'}) as bag:
        bag.add_topic("/pose", POSE, "sensor")
        bag.add_topic("/edges", EDGES, "latched")
        for stamp_ns in range(0, 2_000_000_000, 8_333_333):
            bag.write("/pose", pose(stamp_ns), stamp_ns + 3_000_000)
        edges = blank(EDGES)
        edges.pixel_0 = np.array([1.5, np.nan])
        bag.write("/edges", edges, 1_000_000_000)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    write(tmp_path / "bag")
    return tmp_path / "bag"


def test_our_reader_gives_back_messages_types_and_metadata(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert reader.topics == {"/pose": POSE, "/edges": EDGES}
        assert reader.metadata == {"scene": '{"gap_mm": 4}'}
        messages = list(reader.messages())
        assert [m.time_ns for m in messages] == sorted(m.time_ns for m in messages)
        assert len(messages) == reader.count() == 242
        assert reader.count(["/edges"]) == 1
        poses = [message for message in messages if message.topic == "/pose"]
        assert [reader.deserialize(m).pose.position.x for m in poses] == [
            stamp_ns * 1e-9 for stamp_ns in range(0, 2_000_000_000, 8_333_333)
        ]
        assert [reader.stamp_ns(m) for m in poses] == [m.time_ns - 3_000_000 for m in poses]
        (edges,) = (reader.deserialize(m) for m in reader.messages(["/edges"]))
        np.testing.assert_array_equal(edges.pixel_0, [1.5, np.nan])
        assert not reader.losses


def test_a_bare_file_serves_as_well_as_its_folder(bag: Path) -> None:
    with BagReader(bag) as folder, BagReader(bag / "bag_0.mcap") as file:
        assert list(folder.messages()) == list(file.messages())
        assert file.metadata == folder.metadata


def test_the_mcap_reader_decodes_every_message(bag: Path) -> None:
    with (bag / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [(channel.topic, m) for _, channel, _, m in reader.iter_decoded_messages()]
        assert reader.get_header().profile == "ros2"
    assert len(decoded) == 242
    assert {topic for topic, _ in decoded} == {"/pose", "/edges"}
    assert all(message.header.frame_id == "world" for topic, message in decoded if topic == "/pose")


def test_rosbags_reads_every_message_with_its_quality_of_service(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        assert sum(1 for _ in reader.messages()) == 242
        offered = {
            c.topic: c.ext.offered_qos_profiles[0]
            for c in reader.connections
            if isinstance(c.ext, ConnectionExtRosbag2)
        }
        digests = {c.topic: c.digest for c in reader.connections}
    assert offered["/pose"].reliability == QosReliability.BEST_EFFORT
    assert offered["/edges"].durability == QosDurability.TRANSIENT_LOCAL
    assert digests["/edges"] == typestore().hash_rihs01(EDGES)


def test_the_same_calls_give_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder / "bag")
    same, different, odd = filecmp.cmpfiles(
        tmp_path / "a" / "bag", tmp_path / "b" / "bag", ["bag_0.mcap", "metadata.yaml"], shallow=False
    )
    assert (len(same), different, odd) == (2, [], [])


def test_what_was_written_before_an_exception_stays_readable(tmp_path: Path) -> None:
    def write_half() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            bag.add_topic("/pose", POSE)
            bag.write("/pose", pose(1), 1)
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        write_half()
    with BagReader(tmp_path / "bag") as reader:
        assert [m.time_ns for m in reader.messages()] == [1]


def test_mistakes_are_refused_by_name(tmp_path: Path, bag: Path) -> None:
    with pytest.raises(BagError, match="exists already"):
        BagWriter(bag)
    with pytest.raises(BagError, match="does not exist"):
        BagReader(tmp_path / "nothing")
    with BagReader(bag) as reader, pytest.raises(BagError, match="no topic /gap; it has /edges, /pose"):
        reader.messages(["/gap"])
    with BagWriter(tmp_path / "new") as writer:
        writer.add_topic("/pose", POSE)
        writer.add_topic("/pose", "geometry_msgs/PoseStamped")
        with pytest.raises(BagError, match="has type geometry_msgs/msg/PoseStamped"):
            writer.add_topic("/pose", EDGES)
        with pytest.raises(BagError, match="was not added"):
            writer.write("/gap", pose(0), 0)
        with pytest.raises(BagError, match="definition of nowhere_msgs/msg/Nothing is not found"):
            writer.add_topic("/x", "nowhere_msgs/msg/Nothing")
        with pytest.raises(BagError, match="expected package/msg/Name"):
            writer.add_topic("/x", "Pose")
        unknown: Any = "best"
        with pytest.raises(BagError, match="valid are sensor, reliable, latched"):
            writer.add_topic("/x", POSE, unknown)


def test_an_old_definition_in_a_bag_is_read_as_the_bag_has_it(bag: Path) -> None:
    """The type's name alone does not determine how its bytes are laid out."""
    content = (bag / "bag_0.mcap").read_bytes()
    # In every copy of the schema the pose's two parts change places, as an older version might have had them.
    swapped = content.replace(
        b"geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
        b"geometry_msgs/Quaternion orientation\ngeometry_msgs/Point position",
    )
    assert swapped != content
    without_checksums = bag.parent / "old.mcap"
    without_checksums.write_bytes(_zero_chunk_checksums(swapped))
    with BagReader(without_checksums) as reader:
        message = list(reader.messages(["/pose"]))[-1]
        assert reader.deserialize(message).pose.orientation.x == pytest.approx(2.0, abs=0.01)


def _zero_chunk_checksums(content: bytes) -> bytes:
    """Set the checksum of every chunk, and of the index, to 0: "not given"."""
    out, offset = bytearray(content), 8
    while offset < len(content) - 8:
        opcode = content[offset]
        length = int.from_bytes(content[offset + 1 : offset + 9], "little")
        if opcode == 6:
            out[offset + 9 + 24 : offset + 9 + 28] = bytes(4)
        if opcode == 2:
            out[offset + 9 + 16 : offset + 9 + 20] = bytes(4)
        offset += 9 + length
    return bytes(out)


def write_long(path: Path) -> list[tuple[str, int]]:
    """Twenty seconds of poses in chunks of a second, with what is kept for late subscribers twice."""
    written = []
    with BagWriter(path) as bag:
        bag.add_topic("/pose", POSE, "sensor")
        bag.add_topic("/edges", EDGES, "latched")
        for time_ns in range(0, 20_000_000_000, 100_000_000):
            bag.write("/pose", pose(time_ns), time_ns)
            written.append(("/pose", time_ns))
            if time_ns in (0, 7_500_000_000):
                bag.write("/edges", blank(EDGES), time_ns)
                written.append(("/edges", time_ns))
    return written


@pytest.mark.parametrize("indexed", [True, False], ids=["by the index", "without an index"])
@pytest.mark.parametrize("begin_s", [0.0, 3.0, 7.45, 12.34, 19.9, 25.0])
def test_what_lies_before_a_time_is_not_read(
    begin_s: float, indexed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_long(tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.mcap")
    if not indexed:
        file.write_bytes(file.read_bytes()[:-100])
    read: list[Block] = []
    whole = McapFile.read

    def noted(self: McapFile, block: Block) -> list[Entry]:
        read.append(block)
        return whole(self, block)

    monkeypatch.setattr(McapFile, "read", noted)
    begin_ns = round(begin_s * 1e9)
    with BagReader(tmp_path / "bag") as reader:
        found = [(m.topic, m.time_ns) for m in reader.messages(begin_ns=begin_ns)]
        blocks, opened = len(reader._files[0].blocks), len(read)
        kept = [(m.topic, m.time_ns) for m in reader.messages(begin_ns=begin_ns, before=["/edges"])]
    wanted = [one for one in written if one[1] >= begin_ns]
    assert [one for one in found if one[1] >= begin_ns] == wanted
    assert [one for one in kept if one[0] == "/edges" or one[1] >= begin_ns] == [
        one for one in written if one[0] == "/edges" or one[1] >= begin_ns
    ]
    assert blocks >= 20
    # At most the chunk in which the time lies is read in vain; and those that hold what is kept.
    assert opened <= max(blocks - int(begin_s), 0) + 1
    if indexed:
        assert len(read) - opened <= opened + 2


def test_a_chunk_without_an_end_is_read(tmp_path: Path) -> None:
    write_long(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as reader:
        file = reader._files[0]
        file.blocks = [block._replace(start_ns=block.start_ns + 1, end_ns=0) for block in file.blocks]
        assert sum(1 for _ in reader.messages(begin_ns=19_000_000_000)) == 202
