"""What is left of a damaged bag is given; what is lost is reported; nothing false is ever given."""

import logging
from pathlib import Path

import numpy as np
import pytest

from knee_gap_core.bag.bag import BagMessage, BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.message_types import blank

IMAGE = "sensor_msgs/msg/CompressedImage"
POSE = "geometry_msgs/msg/PoseStamped"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[BagMessage]]:
    """A bag of several chunks, its bytes and its messages."""
    path = tmp_path_factory.mktemp("whole") / "bag"
    rng = np.random.default_rng(5)
    with BagWriter(path, metadata={"scene": "known"}) as bag:
        bag.add_topic("/image", IMAGE, "sensor")
        bag.add_topic("/pose", POSE, "sensor")
        for index in range(40):
            image = blank(IMAGE)
            image.data = rng.integers(0, 256, 100, dtype=np.uint8)
            bag.write("/image", image, 1000 * index)
            pose = blank(POSE)
            pose.pose.position.x = float(index)
            bag.write("/pose", pose, 1000 * index + 500)
            if index % 8 == 7:
                bag.flush()
    with BagReader(path) as reader:
        return (path / "bag_0.mcap").read_bytes(), list(reader.messages())


def read(path: Path, content: bytes) -> tuple[list[BagMessage], tuple[str, ...]]:
    path.write_bytes(content)
    with BagReader(path) as reader:
        messages = list(reader.messages())
        return messages, reader.losses


def test_a_file_cut_anywhere_gives_every_complete_chunk(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path
) -> None:
    content, original = whole
    counts = []
    for length in range(100, len(content), 149):
        messages, losses = read(tmp_path / "cut.mcap", content[:length])
        assert messages == original[: len(messages)]
        assert len(losses) >= 1
        counts.append(len(messages))
    assert counts == sorted(counts)
    # Five chunks of sixteen messages, one after the other.
    assert set(counts) == {0, 16, 32, 48, 64, 80}


def test_a_flipped_byte_never_gives_a_false_message(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path
) -> None:
    content, original = whole
    known = set(original)
    damaged, refused = 0, []
    rng = np.random.default_rng(6)
    for position in rng.choice(len(content), 400, replace=False):
        flipped = bytearray(content)
        flipped[position] ^= int(rng.integers(1, 256))
        try:
            messages, losses = read(tmp_path / "flipped.mcap", bytes(flipped))
        except BagError:
            refused.append(position)
            continue
        assert set(messages) <= known, f"byte {position}"
        assert len(messages) >= len(original) - 16, f"byte {position}: more than its own chunk lost"
        if len(messages) < len(original):
            damaged += 1
            assert losses, f"byte {position}: {len(original) - len(messages)} messages lost in silence"
    assert damaged > 100
    assert all(position < 9 for position in refused), "refused although only the magic makes a file ours"


def test_a_loss_is_told_in_one_line_with_what_was_lost(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content, original = whole
    place = content.index(original[20].data)
    flipped = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    with caplog.at_level(logging.WARNING):
        messages, losses = read(tmp_path / "flipped.mcap", flipped)
    assert messages == original[:16] + original[32:]
    assert [record.message for record in caplog.records] == list(losses)
    assert len(losses) == 1
    assert "16 messages at byte" in losses[0]


def test_a_recording_that_was_killed_keeps_its_metadata(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path
) -> None:
    content, original = whole
    folder = tmp_path / "killed"
    folder.mkdir()
    (folder / "killed.mcap").write_bytes(content[: content.index(original[40].data)])
    with BagReader(folder) as reader:
        assert reader.metadata == {"scene": "known"}
        assert reader.topics == {"/image": IMAGE, "/pose": POSE}
        assert list(reader.messages()) == original[:32]


def test_messages_of_a_topic_whose_announcement_is_lost_are_lost_and_told(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path
) -> None:
    content, original = whole
    place = content.index(original[0].data)
    flipped = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    # Killed in its third chunk, and its first, the only one with definitions, damaged.
    messages, losses = read(tmp_path / "killed.mcap", flipped[: content.index(original[40].data)])
    assert messages == []
    assert any("16 messages at byte" in line and "topic is unknown" in line for line in losses)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("empty.mcap", b"", "is empty"),
        ("text.mcap", b"these are not the bytes of a bag", "is not an MCAP file"),
        ("short.mcap", b"\x89MCAP", "is not an MCAP file"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path: Path, name: str, content: bytes, reason: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match=reason):
        BagReader(tmp_path / name)


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        (
            "storage_identifier: leveldb\n  compression_mode: ''",
            "stored as leveldb; convert it",
        ),
        ("storage_identifier: mcap\n  compression_mode: FILE", "compressed by file; convert it"),
        (None, "holds no .mcap or .db3 file"),
    ],
)
def test_bags_of_other_kinds_are_refused_with_what_to_do(
    tmp_path: Path, metadata: str | None, reason: str
) -> None:
    if metadata is not None:
        (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  {metadata}\n")
    with pytest.raises(BagError, match=reason):
        BagReader(tmp_path)


def test_damaged_metadata_does_not_hide_the_messages(
    whole: tuple[bytes, list[BagMessage]], tmp_path: Path
) -> None:
    content, original = whole
    (tmp_path / "bag_0.mcap").write_bytes(content)
    (tmp_path / "metadata.yaml").write_text("{ not yaml")
    with BagReader(tmp_path) as reader:
        assert list(reader.messages()) == original
        assert reader.losses == ("metadata.yaml is damaged; read without it",)


def test_a_missing_part_of_a_split_bag_is_told(whole: tuple[bytes, list[BagMessage]], tmp_path: Path) -> None:
    content, original = whole
    (tmp_path / "a_1.mcap").write_bytes(content)
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n"
        "  storage_identifier: mcap\n"
        "  relative_file_paths: [a_0.mcap, a_1.mcap]\n"
    )
    with BagReader(tmp_path) as reader:
        assert list(reader.messages()) == original
        assert reader.losses == ("a_0.mcap is missing",)
