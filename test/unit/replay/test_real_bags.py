"""Bags that ROS itself wrote: split, re-indexed, with services, of unknown types, of a wrong middleware."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError

BAGS = Path(__file__).parents[4] / "shared/data/mcap/rosbag2"

pytestmark = pytest.mark.skipif(not BAGS.is_dir(), reason=f"no real bags at {BAGS}")


def every_bag() -> list[Path]:
    return sorted([*BAGS.glob("*"), *BAGS.glob("only_bags/*.mcap")])


def reference(files: list[Path]) -> list[tuple[int, str, bytes]]:
    """Messages as the reference reader gives them, file by file."""
    messages = []
    for path in files:
        with path.open("rb") as file:
            messages += [
                (m.log_time, channel.topic, m.data) for _, channel, m in make_reader(file).iter_messages()
            ]
    return messages


@pytest.mark.parametrize("path", every_bag(), ids=lambda path: str(path.relative_to(BAGS)))
def test_every_message_is_given_in_order_of_time(path: Path) -> None:
    with BagReader(path) as reader:
        messages = [(m.time_ns, m.topic, m.data) for m in reader.messages()]
        assert not reader.losses
    expected = reference([path] if path.is_file() else sorted(path.glob("*.mcap")))
    assert sorted(messages) == sorted(expected)
    assert [m[0] for m in messages] == sorted(m[0] for m in messages)


def test_the_definition_in_the_bag_serves_where_ours_is_unknown() -> None:
    with BagReader(BAGS / "cdr_test") as reader:
        read = [reader.deserialize(message) for message in reader.messages(["/test_topic"])]
    assert [message.int32_value for message in read] == sorted(message.int32_value for message in read)
    assert len(read) == 3


def test_a_foreign_serialisation_is_refused_by_name() -> None:
    with BagReader(BAGS / "wrong_rmw_test") as reader:
        message = next(reader.messages())
        with pytest.raises(BagError, match="serialised as 'wrong_format'; only cdr"):
            reader.deserialize(message)
        assert reader.stamp_ns(message) is None
