"""Parameter files mean to the cores what they mean to the nodes."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.parameters_file import ParametersFile


@dataclass(frozen=True)
class Lens:
    position: tuple[float, ...] = (0.0, 0.0)
    angle: float = 0.5
    name: str = "lens"

    def __post_init__(self) -> None:
        if self.angle < 0:
            raise ValueError(f"angle must not be below 0, is {self.angle}")


@dataclass(frozen=True)
class Limits:
    speed: float = 1.0


NODES: dict[str, tuple[type, ...]] = {"tracking_node": (Lens, Limits)}


def file(tmp_path: Path, text: str) -> ParametersFile:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return ParametersFile(path)


@pytest.mark.parametrize(
    "head",
    [
        "tracking_node:",
        "/knee_gap/tracking_node:",
        "/**/tracking_node:",
        "/**:",
        "'*':",
        "knee_gap:\n tracking_node:",
    ],
)
def test_every_way_to_name_a_node_is_understood(tmp_path: Path, head: str) -> None:
    text = f"{head}\n  ros__parameters:\n    position: [1, 2.5]\n    speed: 3\n"
    lens, limits = file(tmp_path, text).build("tracking_node", NODES["tracking_node"])
    assert lens == Lens(position=(1.0, 2.5))
    assert limits == Limits(3.0)
    assert isinstance(limits.speed, float)


def test_a_node_of_another_name_keeps_its_defaults(tmp_path: Path) -> None:
    text = "other_node:\n  ros__parameters:\n    angle: 1.0\n"
    assert file(tmp_path, text).build("tracking_node", [Lens]) == [Lens()]
    assert ParametersFile(None).build("tracking_node", [Lens]) == [Lens()]


def test_a_nodes_own_value_goes_before_that_of_every_node(tmp_path: Path) -> None:
    text = (
        "tracking_node:\n  ros__parameters:\n    angle: 1.0\n    use_sim_time: true\n"
        "/**:\n  ros__parameters:\n    angle: 2.0\n    name: all\n"
    )
    assert file(tmp_path, text).build("tracking_node", [Lens]) == [Lens(angle=1.0, name="all")]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "tracking_node:\n  ros__parameters:\n    angel: 1.0\n",
            "no parameter angel of tracking_node; there",
        ),
        ("tracking_node:\n  ros__parameters:\n    angle: -1.0\n", "angle must not be below 0"),
        ("/**:\n  ros__parameters:\n    angel: 1.0\n", "no node has a parameter angel"),
        ("angle: 1.0\n", "not a ROS parameter file"),
        ("{ not: [yaml", "not a YAML file"),
    ],
)
def test_mistakes_are_refused_by_name(tmp_path: Path, text: str, reason: str) -> None:
    def use() -> None:
        parameters = file(tmp_path, text)
        parameters.refuse_unknown(NODES)
        parameters.build("tracking_node", NODES["tracking_node"])

    with pytest.raises(BagError, match=reason):
        use()


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file"):
        ParametersFile(tmp_path / "none.yaml")
