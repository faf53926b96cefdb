"""Bags as ROS itself writes them: split, without index, with services, unknown types, a wrong middleware."""

from pathlib import Path

import pytest
from mcap.reader import make_reader
from recordings import BESIDE, MADE, RECORDED, origins
from ros_bags import MADE_BAGS, RECORDED_BAGS, recorded_bags

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.errors import BagError

EVERY_BAG = [(MADE, name) for name in MADE_BAGS] + [(RECORDED, name) for name in recorded_bags()]
ORIGINS = origins(f"{RECORDED_BAGS}/cdr_test", f"{RECORDED_BAGS}/wrong_rmw_test")


def bag(origin: str, name: str, folder: Path) -> Path:
    if origin == RECORDED:
        return BESIDE / RECORDED_BAGS / name
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    return MADE_BAGS[name].write(path)


def reference(files: list[Path]) -> list[tuple[int, str, bytes]]:
    """Messages as the reference reader gives them, file by file."""
    messages = []
    for path in files:
        with path.open("rb") as file:
            messages += [
                (m.log_time, channel.topic, m.data) for _, channel, m in make_reader(file).iter_messages()
            ]
    return messages


@pytest.mark.parametrize(("origin", "name"), EVERY_BAG)
def test_every_message_is_given_in_order_of_time(origin: str, name: str, tmp_path: Path) -> None:
    path = bag(origin, name, tmp_path)
    with BagReader(path) as reader:
        messages = [(m.time_ns, m.topic, m.data) for m in reader.messages()]
        assert not reader.losses
    expected = reference([path] if path.is_file() else sorted(path.glob("*.mcap")))
    assert sorted(messages) == sorted(expected)
    assert [m[0] for m in messages] == sorted(m[0] for m in messages)
    if origin == MADE:
        written = sorted((time_ns, topic, data) for topic, time_ns, data in MADE_BAGS[name].records)
        assert sorted(messages) == written


@pytest.mark.parametrize("origin", ORIGINS)
def test_the_definition_in_the_bag_serves_where_ours_is_unknown(origin: str, tmp_path: Path) -> None:
    with BagReader(bag(origin, "cdr_test", tmp_path)) as reader:
        read = [reader.deserialize(message) for message in reader.messages(["/test_topic"])]
    assert [message.int32_value for message in read] == sorted(message.int32_value for message in read)
    assert len(read) == 3


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_foreign_serialisation_is_refused_by_name(origin: str, tmp_path: Path) -> None:
    with BagReader(bag(origin, "wrong_rmw_test", tmp_path)) as reader:
        message = next(reader.messages())
        with pytest.raises(BagError, match="serialised as 'wrong_format'; only cdr"):
            reader.deserialize(message)
        assert reader.stamp_ns(message) is None
