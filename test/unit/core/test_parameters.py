"""Parameters declared from a dataclass, against a stand-in for the node."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rcl_interfaces")

from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.node.parameters import declare, refuse_unknown, refused_by_ros, require_files
from knee_gap_core.user_files import FileError


@dataclass(frozen=True)
class Settings:
    rate: float = field(default=60.0, metadata={"description": "rate [Hz]", "range": (1.0, 240.0)})
    count: int = field(default=3, metadata={"description": "count [-]", "range": (1, 10)})
    source: str = field(default="raw", metadata={"description": "source", "choices": ("raw", "compressed")})
    offset: tuple[float, ...] = field(default=(0.0, 0.0), metadata={"description": "offset [m]"})
    limit: float = field(
        default=float("nan"), metadata={"description": "limit [m]", "range": (0.0, 1.0), "nan": True}
    )

    medium: str | float = field(default="saline", metadata={"description": "medium"})

    def __post_init__(self) -> None:
        if len(self.offset) != 2:
            raise ValueError(f"offset must have 2 numbers, not {len(self.offset)}")


class StandIn:
    """What `declare` uses of a node, with the range check that rclpy does."""

    def __init__(self, **given: Any) -> None:
        self.given = given
        self._parameters: dict[str, Any] = {}
        self.descriptors: dict[str, Any] = {}

    def declare_parameter(self, name: str, default: Any, descriptor: Any) -> Any:
        value = self.given.get(name, default)
        if type(value) is not type(default) and not descriptor.dynamic_typing:
            raise TypeError("wrong type")
        for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
            if not limits.from_value <= value <= limits.to_value:
                raise ValueError("out of range")
        self._parameters[name] = value
        self.descriptors[name] = descriptor
        return SimpleNamespace(value=value)

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters


def test_defaults_stand_in_one_place() -> None:
    declared = declare(StandIn(), Settings)
    assert (declared.rate, declared.count, declared.source, declared.offset) == (60.0, 3, "raw", (0.0, 0.0))


def test_given_values_reach_the_dataclass() -> None:
    declared = declare(StandIn(rate=120.0, source="compressed", offset=[1.0, 2.0]), Settings)
    assert (declared.rate, declared.source, declared.offset) == (120.0, "compressed", (1.0, 2.0))


def test_descriptors_tell_meaning_range_and_that_they_are_fixed() -> None:
    node = StandIn()
    declare(node, Settings)
    assert node.descriptors["rate"].description == "rate [Hz]"
    assert node.descriptors["rate"].floating_point_range[0].to_value == 240.0
    assert node.descriptors["count"].integer_range[0].from_value == 1
    assert "raw, compressed" in node.descriptors["source"].additional_constraints
    assert "NaN" in node.descriptors["limit"].additional_constraints
    assert all(descriptor.read_only for descriptor in node.descriptors.values())


def test_a_name_or_a_number_is_taken_where_either_is_meant() -> None:
    node = StandIn(medium=1.34)
    assert declare(node, Settings).medium == 1.34
    assert declare(StandIn(medium="air"), Settings).medium == "air"
    assert [name for name, one in node.descriptors.items() if one.dynamic_typing] == ["medium"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"rate": 0.0}, r"rate: must be of type float in \[1, 240\]"),
        ({"rate": "fast"}, "rate: must be of type float"),
        ({"count": 11}, r"count: must be of type int in \[1, 10\]"),
        ({"source": "guess"}, "source is 'guess'; it is one of: raw, compressed"),
        ({"offset": [1.0]}, "offset must have 2 numbers, not 1"),
    ],
)
def test_bad_values_are_refused_in_one_line(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as refusal:
        declare(StandIn(**given), Settings)
    assert "\n" not in str(refusal.value)


def test_misspelt_name_is_refused_with_the_names_there_are() -> None:
    node = StandIn()
    declare(node, Settings)
    node._parameter_overrides = dict.fromkeys(
        ["rate", "use_sim_time", "qos_overrides./clock.subscription.depth"]
    )
    refuse_unknown(node)
    node._parameter_overrides = {"ratte": None}
    with pytest.raises(
        ConfigurationError, match="no parameter ratte; there are: count, limit, medium, offset, rate"
    ):
        refuse_unknown(node)


@pytest.mark.parametrize("name", ["use_sim_timeX", "use_sim_time.x", "start_type_description_services"])
def test_a_name_that_only_begins_like_a_known_one_is_refused(name: str) -> None:
    node = StandIn()
    declare(node, Settings)
    node._parameter_overrides = {name: None}
    with pytest.raises(ConfigurationError, match=f"no parameter {name}; there are"):
        refuse_unknown(node)


def test_what_ros_refuses_is_a_mistake_of_the_user_in_one_line() -> None:
    class InvalidTypeError(Exception):
        """As rclpy's own."""

    with pytest.raises(ConfigurationError, match="'use_sim_time' to 'abc'") as refusal, refused_by_ros():
        raise InvalidTypeError("Trying to set parameter 'use_sim_time' to 'abc'\nof type 'STRING'")
    assert "\n" not in str(refusal.value)


def test_parameter_files_are_looked_at_before_ros_waits_for_them(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "good.yaml").write_text("/**:\n  ros__parameters:\n    a: 1\n")
    require_files(["node", "--ros-args", "--params-file", str(tmp_path / "good.yaml"), "-p", "a:=1"])
    for name, words in (("fifo.yaml", "is a FIFO"), ("none.yaml", "No such file"), (".", "is a folder")):
        with pytest.raises(FileError, match=words):
            require_files(["node", "--ros-args", "--params-file", str(tmp_path / name)])
